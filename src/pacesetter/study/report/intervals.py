"""The interval plot of a page: a dot per algorithm with its interval and its seeds."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import Comparison, Group
from pacesetter.study.report.curves import style

MARGIN = 0.04  # of the span, so that no dot is cut


class Bar(NamedTuple):
    """One algorithm: places in percent of the track's width, and what is printed beside it."""

    name: str
    colour: str
    dot: float
    left: float | None
    width: float
    seeds: list[float]
    text: str


class Track(NamedTuple):
    """One task: its bars, and the returns at the track's two ends."""

    env: str
    bars: list[Bar]
    low: str
    high: str


def tracks(comparison: Comparison) -> Iterator[Track]:
    """A track per task, on which the metric of each algorithm is known."""
    for env in comparison.envs:
        groups = [g for g in comparison.on(env) if np.isfinite(g.values(comparison.metric)).all()]
        if groups:
            yield _track(comparison, env, groups)


def _track(comparison: Comparison, env: str, groups: list[Group]) -> Track:
    metric, styles = comparison.metric, style(comparison.names)
    found = {group.name: (stats.mean(group.values(metric)), group) for group in groups}
    every = np.concatenate([[*mean, *group.values(metric)] for mean, group in found.values()])
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    pad = MARGIN * ((high - low) or 1)
    low, high = low - pad, high + pad

    def place(value: float) -> float:
        return round(100 * (value - low) / (high - low), 2)

    bars: list[Bar] = []
    for name, (mean, group) in found.items():
        known = bool(np.isfinite(mean.low))
        reach = f" [{mean.low:,.0f}; {mean.high:,.0f}]" if known else ""
        bars.append(
            Bar(
                name,
                styles[name][0],
                place(mean.value),
                place(mean.low) if known else None,
                round(place(mean.high) - place(mean.low), 2) if known else 0.0,
                [place(value) for value in group.values(metric)],
                f"{mean.value:,.0f}{reach}, n={len(group.runs)}",
            )
        )
    return Track(env, bars, f"{low:,.0f}", f"{high:,.0f}")

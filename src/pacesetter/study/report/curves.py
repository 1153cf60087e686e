"""Learning curves of groups against what they cost, and performance profiles."""

from dataclasses import dataclass

import numpy as np

from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import Comparison, Group
from pacesetter.study.compare.results import Run
from pacesetter.study.compare.stats import Array
from pacesetter.study.report.contrasts import shared

# Okabe and Ito's colours, which colour-blind people tell apart, without their yellow, and with grey
# for their black, which a dark page would swallow.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6F6F6F")
DASHES = ("", "6 3", "2 2", "8 3 2 3")  # SVG; a second sign besides colour
PAPER = {"multi-td3": 0, "td3": 1, "sunrise": 2}  # blue, red and green as in the paper's figure
LEVELS = 101


@dataclass(frozen=True)
class Curve:
    """Mean over seeds at x (N,) and its 95% t interval, NaN for one seed."""

    x: Array
    mean: Array
    low: Array
    high: Array


def style(names: list[str]) -> dict[str, tuple[str, str]]:
    """A colour and a dash pattern for each algorithm."""
    free = [place for place in range(len(names) + len(PAPER)) if place not in PAPER.values()]
    places = [PAPER[name] if name in PAPER else free.pop(0) for name in names]
    return {
        name: (COLOURS[place % len(COLOURS)], DASHES[place // len(COLOURS) % len(DASHES)])
        for name, place in zip(names, places, strict=True)
    }


def spending(run: Run, axis: str) -> Array:
    """What a run had spent of an axis at each evaluation."""
    return run.clock if axis == "steps" else getattr(run, axis)


def curve(group: Group, axis: str, window: int | None = None) -> Curve:
    """Mean of the seeds at common x, as far as all of them went.

    The interval is computed from raw evaluations; only then are the lines smoothed, if at all.
    """
    sides = [_rising(spending(run, axis), run.returns) for run in group.runs]
    first, last = max(x[0] for x, _ in sides), min(x[-1] for x, _ in sides)
    grid = np.linspace(first, last, min(len(x) for x, _ in sides))
    lines = stats.band(np.array([np.interp(grid, x, y) for x, y in sides]))
    if window:
        lines = tuple(stats.smooth(line, window) for line in lines)
    return Curve(grid, *lines)


def _rising(x: Array, y: Array) -> tuple[Array, Array]:
    """Only the last of equal x, such as no updates during warm-up."""
    last = np.append(np.diff(x) > 0, True)
    return x[last], y[last]


def profiles(comparison: Comparison) -> tuple[str, dict[str, Curve]] | None:
    """Axis label and performance profile of each algorithm, on scores or, on one task, returns."""
    if scores := shared(comparison):
        label = f"score: {comparison.metric} return over TD3's published one"
    elif len(comparison.envs) == 1:
        env = comparison.envs[0]
        label = f"{comparison.metric} return, {env}"
        groups = comparison.groups
        scores = {group.name: [group.values(comparison.metric)] for group in groups}
    else:
        return None
    every = np.concatenate([task for tasks in scores.values() for task in tasks])
    if not np.isfinite(every).all():
        return None
    margin = 0.05 * (np.ptp(every) or 1)
    levels = np.linspace(every.min() - margin, every.max() + margin, LEVELS)
    return label, {
        name: Curve(levels, *stats.profile(tasks, levels)) for name, tasks in scores.items()
    }

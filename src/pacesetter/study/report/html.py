"""A comparison as one HTML file that needs nothing else: tables, curves, a film, commands."""

import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from pacesetter.runs.provenance import versions
from pacesetter.storage import as_json
from pacesetter.study.compare import lineage
from pacesetter.study.compare.groups import Comparison
from pacesetter.study.compare.results import AXES, Run
from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report import contents
from pacesetter.study.report.curves import Curve, curve, profiles, spending, style
from pacesetter.study.report.figures import figure_2, svg
from pacesetter.study.report.films import Film
from pacesetter.study.report.headline import headline
from pacesetter.study.report.intervals import tracks
from pacesetter.study.report.tables import Table, merge, numeric

HERE = Path(__file__).parent
DIGITS = 5  # of a number in a curve


class Descent(NamedTuple):
    """Who descends from whom in one run, as SVG paths."""

    title: str
    every: str
    line: str
    width: int
    height: int


def report(
    comparison: Comparison,
    own: Sequence[Table],
    beside: Sequence[Table],
    films: Sequence[Film] = (),
    window: int | None = None,
) -> str:
    """The page: the result, these runs' own tables, then what stands beside them.

    Curves are smoothed over a window of evaluations if one is given.
    """
    library = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    first, *rest = own
    alone = len(comparison.envs) == 1
    drawn = figure_2([comparison], window)
    return library.get_template("report.html.jinja").render(
        title=contents.title(comparison),
        result=headline(comparison),
        small_print=_small_print,
        numeric=numeric,
        notes=comparison.notes,
        first=first,
        tables=[merge(table, alone) for table in rest],
        beside=[merge(table, alone) for table in beside],
        runs=merge(contents.runs(comparison), alone),
        intervals=list(tracks(comparison)),
        metric=contents.NAMES[comparison.metric],
        versions=contents.made_with(comparison),
        data=_embed({"styles": style(comparison.names), "charts": _charts(comparison, window)}),
        smoothed=f"Savitzky-Golay, window {window}, order {SMOOTHING_ORDER}" if window else "",
        figure_2=Markup(svg(drawn)) if drawn is not None else "",
        descents=list(_descents(comparison)),
        films=films,
        command=shlex.join(["pacesetter", *sys.argv[1:]]),
        own=", ".join(f"{name} {number}" for name, number in versions().items()),
        style=Markup((HERE / "report.css").read_text("utf-8")),
        script=Markup((HERE / "report.js").read_text("utf-8")),
    )


def _small_print(text: str) -> tuple[str, str]:
    """A cell's main words, and its interval and remarks, which go below."""
    found = re.search(r" [\[(]", text)
    return (text[: found.start()], text[found.start() + 1 :]) if found else (text, "")


def _embed(table: Any) -> Markup:
    """JSON inside a script element, which `<` could end."""
    return Markup(as_json(table, separators=(",", ":")).replace("<", "\\u003c"))


def _charts(comparison: Comparison, window: int | None) -> list[dict[str, Any]]:
    charts: list[dict[str, Any]] = []
    for env in comparison.envs:
        groups = comparison.on(env)
        lines = {
            axis: {group.name: _line(curve(group, axis, window)) for group in groups}
            for axis in AXES
        }
        seeds = {group.name: [_seed(run) for run in group.runs] for group in groups}
        charts.append({"title": env, "y": "return", "axes": AXES, "lines": lines, "seeds": seeds})
    if found := profiles(comparison):
        label, named = found
        lines = {"profile": {name: _line(one) for name, one in named.items()}}
        share = "share of runs above"
        about = {"axes": {"profile": label}, "lines": lines, "seeds": {}}
        charts.append({"title": "Performance profile", "y": share, **about})
    return charts


def _line(one: Curve) -> list[Any]:
    return [_numbers(values) for values in (one.x, one.mean, one.low, one.high)]


def _seed(run: Run) -> dict[str, Any]:
    axes = {axis: _numbers(spending(run, axis)) for axis in AXES}
    return {"name": f"seed {run.seed}", "y": _numbers(run.returns), **axes}


def _numbers(values: Any) -> list[float | None]:
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]


def _descents(comparison: Comparison) -> Iterable[Descent]:
    """One run of each group that selects; the table has them all."""
    for group in comparison.groups:
        run = next((run for run in group.runs if run.selections), None)
        if run is not None:
            found = lineage.Selections.of(run.selections)
            heading = f"{group.env} {group.name} seed {run.seed}, {len(found.gaps)} selections"
            yield Descent(heading, *lineage.diagram(found))

"""A comparison as one HTML file that needs nothing else: tables, curves, a film, commands."""

import base64
import re
import shlex
import sys
from collections.abc import Collection, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from pacesetter.errors import UsageError
from pacesetter.runs.provenance import versions
from pacesetter.storage import as_json
from pacesetter.study.compare import lineage
from pacesetter.study.compare.comparison import Comparison
from pacesetter.study.compare.results import AXES, Run
from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report import contents
from pacesetter.study.report.curves import Curve, curve, profiles, spending, style
from pacesetter.study.report.figures import figure_2, svg
from pacesetter.study.report.tables import Table

HERE = Path(__file__).parent
FILM_FRAMES = 200
FILM_SIZE = (480, 320)
DIGITS = 5  # of a number in a curve


class Film(NamedTuple):
    """A champion at its task, as a data URL; or why there is none."""

    caption: str
    data: str = ""


class Descent(NamedTuple):
    """Who descends from whom in one run, as SVG paths."""

    title: str
    every: str
    line: str
    width: int
    height: int


def report(
    comparison: Comparison,
    tables: Iterable[Table],
    *,
    window: int | None = None,
    film: bool = True,
    allow: Collection[str] = (),
) -> str:
    """The page. Tables in order; curves smoothed over a window of evaluations if one is given.

    Films are of the tasks that import no module, and of those that `allow` names.
    """
    library = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    first, *rest = tables
    drawn = figure_2(comparison, window)
    return library.get_template("report.html.jinja").render(
        title=contents.title(comparison),
        small_print=_small_print,
        notes=comparison.notes,
        first=first,
        tables=rest,
        runs=contents.runs(comparison),
        versions=contents.made_with(comparison),
        data=_embed({"styles": style(comparison.names), "charts": _charts(comparison, window)}),
        smoothed=f"Savitzky-Golay, window {window}, order {SMOOTHING_ORDER}" if window else "",
        figure_2=Markup(svg(drawn)) if drawn is not None else "",
        descents=list(_descents(comparison)),
        films=[_film(run, allow) for run in _champions(comparison)] if film else [],
        command=shlex.join(["pacesetter", *sys.argv[1:]]),
        own=", ".join(f"{name} {number}" for name, number in versions().items()),
        style=Markup((HERE / "report.css").read_text()),
        script=Markup((HERE / "report.js").read_text()),
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
        groups = [g for name in comparison.names if (g := comparison.find(env, name))]
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


def _champions(comparison: Comparison) -> Iterable[Run]:
    """The best run of each task."""
    for env in comparison.envs:
        runs = [run for run in comparison.runs if run.env == env]
        yield max(runs, key=lambda run: run.metric("final"))


def _film(run: Run, allow: Collection[str]) -> Film:
    """The policy that a run ended with."""
    what = f"{run.env}: {run.name} seed {run.seed}"
    if run.folder is None:
        return Film(f"{what}: no film, since results hold no policy; name its run directory.")
    from pacesetter.media.record import record
    from pacesetter.policy import load

    try:
        policy = load(run.folder / "policy.safetensors")
        with TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            own = policy.about.get("env")
            env = own if own in allow else None
            record(policy, path, env=env, frames=FILM_FRAMES, size=FILM_SIZE)
            data = base64.b64encode(path.read_bytes()).decode()
    except UsageError as error:
        return Film(f"{what}: no film: {error}")
    step = policy.about.get("step", 0)
    caption = (
        f"{what}, the policy of step {step:,}: the best of {run.env} by final return, so it "
        "flatters."
    )
    return Film(caption, f"data:video/mp4;base64,{data}")

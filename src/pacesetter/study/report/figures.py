"""Figures on paper: curves, intervals, profiles, and the paper's figure 2 in its layout."""

from collections.abc import Mapping
from datetime import datetime
from io import StringIO
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import Comparison, Group, split
from pacesetter.study.compare.results import AXES
from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report.contents import NAMES, title
from pacesetter.study.report.curves import Curve, curve, profiles, style
from pacesetter.study.report.paper import PAPER, TASKS
from pacesetter.study.report.tables import steps

COLUMNS = 3
BAND = "95% t interval (cut where far wider)"
FIGURE_2 = tuple(PAPER.values())
Styles = Mapping[str, tuple[str, str]]


def pdf(comparison: Comparison, path: Path, window: int | None = None) -> None:
    """A page of curves per axis, intervals, profiles, and figure 2 if there are runs for it."""
    from matplotlib.backends.backend_pdf import PdfPages

    pages = [page(comparison, axis, window) for axis in AXES]
    pages += [interval_page(comparison), profile_page(comparison), figure_2(comparison, window)]
    # A fixed date, so that the same runs give the same file.
    about: Any = {"CreationDate": datetime(2000, 1, 1), "Title": "pacesetter compare"}
    with PdfPages(path, metadata=about) as file:
        for figure in pages:
            if figure is not None:
                file.savefig(figure)


def picture(
    comparison: Comparison, path: Path, window: int | None = None, axis: str = "steps"
) -> None:
    """One PNG or SVG: each task's curves, and its intervals below or, for one task, beside them."""
    import matplotlib

    envs = comparison.envs
    columns = min(COLUMNS, len(envs))
    rows = -(-len(envs) // columns)
    figure, panels = _figure(2 * rows, columns) if len(envs) > 1 else _figure(1, 2)
    for panel in panels.flat:
        panel.set_visible(False)
    for place, env in enumerate(envs):
        row, column = 2 * (place // columns), place % columns
        above = panels[row, column]
        below = panels[row + 1, column] if len(envs) > 1 else panels[0, 1]
        _curves(above, comparison, env, axis, window)
        above.get_legend().remove()  # the intervals name the colours
        _intervals(below, comparison, env)
        above.set_visible(True)
        below.set_visible(True)
    _head(figure, f"{title(comparison)}: mean over seeds and {BAND}{_smoothed(window)}")
    about = {"Date": None} if path.suffix == ".svg" else {}
    with matplotlib.rc_context({"svg.hashsalt": "pacesetter"}):
        figure.savefig(path, dpi=150, metadata=about)


def _figure(rows: int, columns: int) -> tuple[Any, Any]:
    """Panels of a fixed size; margins in inches, since a layout engine draws everything twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height, wide, high = 3.4, 2.4, 0.95, 0.9
    size = (columns * (width + wide) + 0.2, rows * (height + high) + 0.4)
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    figure.subplots_adjust(
        left=0.9 / size[0],
        right=1 - 0.2 / size[0],
        bottom=0.55 / size[1],
        top=1 - 0.75 / size[1],
        wspace=wide / width,
        hspace=high / height,
    )
    return figure, figure.subplots(rows, columns, squeeze=False)


def _panels(count: int) -> tuple[Any, list[Any]]:
    """A figure with so many panels in rows of COLUMNS."""
    columns = min(COLUMNS, count)
    figure, panels = _figure(-(-count // columns), columns)
    for panel in panels.flat[count:]:
        panel.set_visible(False)
    return figure, list(panels.flat[:count])


def page(comparison: Comparison, axis: str, window: int | None = None) -> Any:
    """All tasks against one axis."""
    figure, panels = _panels(len(comparison.envs))
    for env, panel in zip(comparison.envs, panels, strict=True):
        _curves(panel, comparison, env, axis, window)
    _head(figure, f"Mean over seeds and {BAND}{_smoothed(window)}")
    return figure


def _curves(panel: Any, comparison: Comparison, env: str, axis: str, window: int | None) -> None:
    styles = style(comparison.names)
    for group in comparison.on(env):
        label = f"{group.name} (n={len(group.runs)})"
        _draw(panel, curve(group, axis, window), styles[group.name], label)
    _label(panel, env, AXES[axis], "return")
    _fit(panel)
    panel.legend(frameon=False, fontsize="small")


def interval_page(comparison: Comparison) -> Any:
    """The metric of each algorithm on each task, with its interval."""
    figure, panels = _panels(len(comparison.envs))
    for env, panel in zip(comparison.envs, panels, strict=True):
        _intervals(panel, comparison, env)
    _head(figure, f"{NAMES[comparison.metric]}: mean over seeds, 95% t interval, and each seed")
    return figure


def _intervals(panel: Any, comparison: Comparison, env: str) -> None:
    """A dot per algorithm with its interval as a bar, and a small ring per seed."""
    styles, groups = style(comparison.names), comparison.on(env)
    for place, group in enumerate(groups):
        values = group.values(comparison.metric)
        found, (colour, dashes) = stats.mean(values), styles[group.name]
        line: Any = {"linewidth": 3, "alpha": 0.45, "linestyle": _pattern(dashes)}
        panel.hlines(place, found.low, found.high, color=colour, **line)
        panel.plot(values, [place] * len(values), "o", color=colour, fillstyle="none", markersize=4)
        panel.plot(found.value, place, "o", color=colour, markersize=7)
        label, across = f"{group.name} (n={len(group.runs)})", panel.get_yaxis_transform()
        about: Any = {"fontsize": "x-small", "va": "bottom"}
        panel.text(0.01, place - 0.2, label, transform=across, **about)
    panel.set_yticks([])
    panel.set_ylim(len(groups) - 0.5, -0.8)
    _label(panel, env, NAMES[comparison.metric].lower(), "")


def profile_page(comparison: Comparison) -> Any:
    """Performance profiles, if there are any."""
    found = profiles(comparison)
    if found is None:
        return None
    label, lines = found
    styles = style(comparison.names)
    figure, panels = _figure(1, 1)
    for name, line in lines.items():
        _draw(panels[0, 0], line, styles[name], name)
    _label(panels[0, 0], "Performance profile", label, "share of runs above")
    panels[0, 0].legend(frameon=False)
    return figure


def figure_2(comparison: Comparison, window: int | None = None) -> Any:
    """The paper's figure 2: SUNRISE above, TD3 below, Multi-TD3 in both; None without any pair.

    Of its six panels only those are drawn for which there are runs of both algorithms.
    """
    found = [(task, pair) for pair in FIGURE_2 for task in TASKS]
    shown = [(task, pair, _pair(comparison, task, pair)) for task, pair in found]
    shown = [one for one in shown if {group.name for group in one[2]} == {*one[1]}]
    if not shown:
        return None
    styles = style(comparison.names)
    columns = [task for task in TASKS if any(task == one[0] for one in shown)]
    rows = [pair for pair in FIGURE_2 if any(pair == one[1] for one in shown)]
    figure, panels = _figure(len(rows), len(columns))
    for panel in panels.flat:
        panel.set_visible(False)
    for task, pair, groups in shown:
        panel = panels[rows.index(pair), columns.index(task)]
        panel.set_visible(True)
        end = min(curve(group, "steps").x[-1] for group in groups)
        for group in groups:
            line = _until(curve(group, "steps", window), end)
            label = f"{group.name} ({split(group.env)[1]}, n={len(group.runs)})"
            _draw(panel, line, styles[group.name], label)
        _label(panel, f"{task}, {' and '.join(pair)}", f"env steps to {steps(end)}", "return")
        _fit(panel)
        panel.legend(frameon=False, fontsize="small")
    _head(
        figure,
        f"The paper's figure 2: return against env steps of all members, mean over seeds and {BAND}"
        f"{_smoothed(window)}",
    )
    return figure


def _pair(comparison: Comparison, task: str, pair: tuple[str, str]) -> list[Group]:
    return [g for g in comparison.groups if g.name in pair and split(g.env)[0] == task]


def _head(figure: Any, text: str) -> None:
    words = fill(text, int(13 * figure.get_figwidth()))
    figure.suptitle(words, fontsize="small", parse_math=False)  # a `$` is a word's, not math


def svg(figure: Any) -> str:
    """A figure as an SVG element for a page, without the XML head."""
    import matplotlib

    text = StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "pacesetter"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _until(line: Curve, end: float) -> Curve:
    kept = line.x <= end
    return Curve(line.x[kept], line.mean[kept], line.low[kept], line.high[kept])


def _smoothed(window: int | None) -> str:
    if not window:
        return ""
    order = SMOOTHING_ORDER
    return f"; smoothed for the eye by Savitzky-Golay, window {window}, order {order}"


def _pattern(dashes: str) -> Any:
    """SVG dashes as matplotlib takes them."""
    return (0, tuple(int(n) / 2 for n in dashes.split())) if dashes else "-"


def _draw(panel: Any, line: Curve, style: tuple[str, str], label: str) -> None:
    colour, dashes = style
    pattern = _pattern(dashes)
    mark = "o" if len(line.x) == 1 else None  # a line of one point is not seen
    panel.plot(
        line.x, line.mean, color=colour, linestyle=pattern, label=label, linewidth=1.5, marker=mark
    )
    if np.isfinite(line.low).any():
        panel.fill_between(line.x, line.low, line.high, color=colour, alpha=0.18, linewidth=0)


def _fit(panel: Any) -> None:
    """Show the means whole, and of the intervals no more than that height again on each side.

    That of two seeds can be ten times as wide as everything else.
    """
    means = np.concatenate([line.get_ydata() for line in panel.lines])
    low, high = panel.get_ylim()
    height = np.ptp(means) or 1.0
    panel.set_ylim(max(low, means.min() - height), min(high, means.max() + height))


def _label(panel: Any, title: str, x: str, y: str) -> None:
    from matplotlib.ticker import EngFormatter

    panel.set_title(title, fontsize="medium", parse_math=False)
    panel.set_xlabel(x, parse_math=False)
    panel.set_ylabel(y, parse_math=False)
    if not x.startswith("score"):
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)

"""Figures on paper: curves, intervals, profiles, and the paper's figure 2 in its layout."""

from collections.abc import Sequence
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any

from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import Comparison, Group, split
from pacesetter.study.compare.results import AXES
from pacesetter.study.report.contents import NAMES, title
from pacesetter.study.report.curves import Curve, curve, profiles, style
from pacesetter.study.report.panels import (
    BAND,
    COLUMNS,
    dashed,
    draw,
    fit_height,
    grid,
    head,
    in_rows,
    label_axes,
    smoothing,
)
from pacesetter.study.report.paper import PAPER, TASKS
from pacesetter.study.report.tables import steps

FIGURE_2 = tuple(PAPER.values())


def pdf(comparison: Comparison, path: Path, window: int | None = None) -> None:
    """A page of curves per axis, intervals, profiles, and figure 2 if there are runs for it."""
    from matplotlib.backends.backend_pdf import PdfPages

    pages = [page(comparison, axis, window) for axis in AXES]
    pages += [interval_page(comparison), profile_page(comparison), figure_2([comparison], window)]
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
    figure, panels = grid(2 * rows, columns) if len(envs) > 1 else grid(1, 2)
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
    head(figure, f"{title(comparison)}: mean over seeds and {BAND}{smoothing(window)}")
    about = {"Date": None} if path.suffix == ".svg" else {}
    with matplotlib.rc_context({"svg.hashsalt": "pacesetter"}):
        figure.savefig(path, dpi=150, metadata=about)


def page(comparison: Comparison, axis: str, window: int | None = None) -> Any:
    """All tasks against one axis."""
    figure, panels = in_rows(len(comparison.envs))
    for env, panel in zip(comparison.envs, panels, strict=True):
        _curves(panel, comparison, env, axis, window)
    head(figure, f"Mean over seeds and {BAND}{smoothing(window)}")
    return figure


def _curves(panel: Any, comparison: Comparison, env: str, axis: str, window: int | None) -> None:
    styles = style(comparison.names)
    for group in comparison.on(env):
        label = f"{group.name} (n={len(group.runs)})"
        draw(panel, curve(group, axis, window), styles[group.name], label)
    label_axes(panel, env, AXES[axis], "return")
    fit_height(panel)
    panel.legend(frameon=False, fontsize="small")


def interval_page(comparison: Comparison) -> Any:
    """The metric of each algorithm on each task, with its interval."""
    figure, panels = in_rows(len(comparison.envs))
    for env, panel in zip(comparison.envs, panels, strict=True):
        _intervals(panel, comparison, env)
    head(figure, f"{NAMES[comparison.metric]}: mean over seeds, 95% t interval, and each seed")
    return figure


def _intervals(panel: Any, comparison: Comparison, env: str) -> None:
    """A dot per algorithm with its interval as a bar, and a small ring per seed."""
    styles, groups = style(comparison.names), comparison.on(env)
    for place, group in enumerate(groups):
        values = group.values(comparison.metric)
        found, (colour, dashes) = stats.mean(values), styles[group.name]
        line: Any = {"linewidth": 3, "alpha": 0.45, "linestyle": dashed(dashes)}
        panel.hlines(place, found.low, found.high, color=colour, **line)
        panel.plot(values, [place] * len(values), "o", color=colour, fillstyle="none", markersize=4)
        panel.plot(found.value, place, "o", color=colour, markersize=7)
        label, across = f"{group.name} (n={len(group.runs)})", panel.get_yaxis_transform()
        about: Any = {"fontsize": "x-small", "va": "bottom"}
        panel.text(0.01, place - 0.2, label, transform=across, **about)
    panel.set_yticks([])
    panel.set_ylim(len(groups) - 0.5, -0.8)
    label_axes(panel, env, NAMES[comparison.metric].lower(), "")


def profile_page(comparison: Comparison) -> Any:
    """Performance profiles, if there are any."""
    found = profiles(comparison)
    if found is None:
        return None
    label, lines = found
    styles = style(comparison.names)
    figure, panels = grid(1, 1)
    for name, line in lines.items():
        draw(panels[0, 0], line, styles[name], name)
    label_axes(panels[0, 0], "Performance profile", label, "share of runs above")
    panels[0, 0].legend(frameon=False)
    return figure


def figure_2(comparisons: Sequence[Comparison], window: int | None = None) -> Any:
    """The paper's figure 2: SUNRISE above, TD3 below, Multi-TD3 in both; None without any pair.

    Of its six panels only those are drawn for which a comparison has runs of both algorithms. The
    first such comparison counts: the paper's two tables have budgets and settings of their own.
    """
    found = [(task, pair) for pair in FIGURE_2 for task in TASKS]
    shown = {one: groups for one in found if (groups := _pair(comparisons, *one))}
    if not shown:
        return None
    columns = [task for task in TASKS if any(task == one for one, _ in shown)]
    rows = [pair for pair in FIGURE_2 if any(pair == one for _, one in shown)]
    figure, panels = grid(len(rows), len(columns))
    for panel in panels.flat:
        panel.set_visible(False)
    for (task, pair), groups in shown.items():
        panel = panels[rows.index(pair), columns.index(task)]
        panel.set_visible(True)
        _beside(panel, f"{task}, {' and '.join(pair)}", groups, window)
    head(
        figure,
        f"The paper's figure 2: return against env steps of all members, mean over seeds and {BAND}"
        f"{smoothing(window)}",
    )
    return figure


def _pair(comparisons: Sequence[Comparison], task: str, pair: tuple[str, str]) -> list[Group]:
    """Both algorithms' groups on a task, from the first comparison that has them; or none."""
    for comparison in comparisons:
        groups = [g for g in comparison.groups if g.name in pair and split(g.env)[0] == task]
        if {group.name for group in groups} == {*pair}:
            return groups
    return []


def _beside(panel: Any, words: str, groups: list[Group], window: int | None) -> None:
    """Curves up to where the shorter one ended."""
    styles = style([group.name for group in groups])
    end = min(curve(group, "steps").x[-1] for group in groups)
    for group in groups:
        line = _until(curve(group, "steps", window), end)
        label = f"{group.name} ({split(group.env)[1]}, n={len(group.runs)})"
        draw(panel, line, styles[group.name], label)
    label_axes(panel, words, f"env steps to {steps(end)}", "return")
    fit_height(panel)
    panel.legend(frameon=False, fontsize="small")


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

"""Curves on paper: a PDF of pages, and the paper's figure 2 in its layout."""

from collections.abc import Mapping
from datetime import datetime
from io import StringIO
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from pacesetter.study.compare.comparison import Comparison, split
from pacesetter.study.compare.results import AXES
from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report.curves import Curve, curve, profiles, style
from pacesetter.study.report.paper import TASKS
from pacesetter.study.report.tables import steps

COLUMNS = 3
FIGURE_2 = (("multi-td3", "sunrise"), ("multi-td3", "td3"))
Styles = Mapping[str, tuple[str, str]]


def pdf(comparison: Comparison, path: Path, window: int | None = None) -> None:
    """A page of curves for each axis, the profiles, and figure 2 if there are runs for it."""
    from matplotlib.backends.backend_pdf import PdfPages

    pages = [page(comparison, axis, window) for axis in AXES]
    pages += [profile_page(comparison), figure_2(comparison, window)]
    # A fixed date, so that the same runs give the same file.
    about: Any = {"CreationDate": datetime(2000, 1, 1), "Title": "pacesetter compare"}
    with PdfPages(path, metadata=about) as file:
        for figure in pages:
            if figure is not None:
                file.savefig(figure)


def _figure(rows: int, columns: int) -> tuple[Any, Any]:
    """Panels of a fixed size; margins in inches, since a layout engine draws everything twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height, wide, high = 3.4, 2.4, 0.85, 0.9
    size = (columns * (width + wide) + 0.2, rows * (height + high) + 0.4)
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    figure.subplots_adjust(
        left=0.8 / size[0],
        right=1 - 0.2 / size[0],
        bottom=0.55 / size[1],
        top=1 - 0.75 / size[1],
        wspace=wide / width,
        hspace=high / height,
    )
    return figure, figure.subplots(rows, columns, squeeze=False)


def page(comparison: Comparison, axis: str, window: int | None = None) -> Any:
    """All tasks against one axis."""
    envs, styles = comparison.envs, style(comparison.names)
    columns = min(COLUMNS, len(envs))
    figure, panels = _figure(-(-len(envs) // columns), columns)
    for panel in panels.flat[len(envs) :]:
        panel.set_visible(False)
    for env, panel in zip(envs, panels.flat, strict=False):
        for group in comparison.groups:
            if group.env == env:
                label = f"{group.name} (n={len(group.runs)})"
                _draw(panel, curve(group, axis, window), styles[group.name], label)
        _label(panel, env, AXES[axis], "return")
        panel.legend(frameon=False, fontsize="small")
    _head(figure, f"Mean over seeds and 95% t interval{_smoothed(window)}")
    return figure


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
    """The paper's figure 2: three tasks, SUNRISE above, TD3 below, Multi-TD3 in both; or None."""
    names = {name for pair in FIGURE_2 for name in pair}
    groups = [g for g in comparison.groups if g.name in names and split(g.env)[0] in TASKS]
    if not {"multi-td3"} < {group.name for group in groups}:
        return None
    styles = style(comparison.names)
    figure, panels = _figure(2, 3)
    for row, pair in zip(panels, FIGURE_2, strict=True):
        for task, panel in zip(TASKS, row, strict=True):
            shown = [g for g in groups if split(g.env)[0] == task and g.name in pair]
            end = min((curve(g, "steps").x[-1] for g in shown), default=0)
            for group in shown:
                line = _until(curve(group, "steps", window), end)
                label = f"{group.name} ({split(group.env)[1]}, n={len(group.runs)})"
                _draw(panel, line, styles[group.name], label)
            title = f"{task}, {' and '.join(pair)}"
            _label(panel, title, f"env steps to {steps(end)}" if shown else "", "return")
            if shown:
                panel.legend(frameon=False, fontsize="small")
            else:
                panel.text(0.5, 0.5, "no runs", ha="center", transform=panel.transAxes)
                panel.set(xticks=[], yticks=[], ylabel="")
    _head(
        figure,
        "The paper's figure 2: return against env steps of all members, mean over seeds and 95% t "
        f"interval{_smoothed(window)}",
    )
    return figure


def _head(figure: Any, text: str) -> None:
    figure.suptitle(fill(text, int(13 * figure.get_figwidth())), fontsize="small")


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


def _draw(panel: Any, line: Curve, style: tuple[str, str], label: str) -> None:
    colour, dashes = style
    pattern = (0, tuple(int(n) / 2 for n in dashes.split())) if dashes else "-"
    panel.plot(line.x, line.mean, color=colour, linestyle=pattern, label=label, linewidth=1.5)
    if np.isfinite(line.low).any():
        panel.fill_between(line.x, line.low, line.high, color=colour, alpha=0.18, linewidth=0)


def _label(panel: Any, title: str, x: str, y: str) -> None:
    from matplotlib.ticker import EngFormatter

    panel.set_title(title, fontsize="medium")
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    if not x.startswith("score"):
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)

"""The parts of a figure on paper: panels in a grid, a curve with its band, labelled axes."""

from textwrap import fill
from typing import Any

import numpy as np

from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report.curves import Curve

COLUMNS = 3
BAND = "95% t interval (cut where far wider)"


def grid(rows: int, columns: int) -> tuple[Any, Any]:
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


def in_rows(count: int) -> tuple[Any, list[Any]]:
    """A figure with so many panels in rows of COLUMNS."""
    columns = min(COLUMNS, count)
    figure, panels = grid(-(-count // columns), columns)
    for panel in panels.flat[count:]:
        panel.set_visible(False)
    return figure, list(panels.flat[:count])


def head(figure: Any, text: str) -> None:
    """A line above all panels, broken where it is wider than they are."""
    words = fill(text, int(13 * figure.get_figwidth()))
    figure.suptitle(words, fontsize="small", parse_math=False)  # a `$` is a word's, not math


def smoothing(window: int | None) -> str:
    """What a heading says of smoothed curves."""
    if not window:
        return ""
    order = SMOOTHING_ORDER
    return f"; smoothed for the eye by Savitzky-Golay, window {window}, order {order}"


def dashed(dashes: str) -> Any:
    """SVG dashes as matplotlib takes them."""
    return (0, tuple(int(n) / 2 for n in dashes.split())) if dashes else "-"


def draw(panel: Any, line: Curve, style: tuple[str, str], label: str) -> None:
    """A curve in a colour and dash pattern, with its interval as a band."""
    colour, dashes = style
    pattern = dashed(dashes)
    mark = "o" if len(line.x) == 1 else None  # a line of one point is not seen
    panel.plot(
        line.x, line.mean, color=colour, linestyle=pattern, label=label, linewidth=1.5, marker=mark
    )
    if np.isfinite(line.low).any():
        panel.fill_between(line.x, line.low, line.high, color=colour, alpha=0.18, linewidth=0)


def fit_height(panel: Any) -> None:
    """Show the means whole, and of the intervals no more than that height again on each side.

    That of two seeds can be ten times as wide as everything else.
    """
    means = np.concatenate([line.get_ydata() for line in panel.lines])
    low, high = panel.get_ylim()
    height = np.ptp(means) or 1.0
    panel.set_ylim(max(low, means.min() - height), min(high, means.max() + height))


def label_axes(panel: Any, title: str, x: str, y: str) -> None:
    """A title, axes with words, and thousands as 10k."""
    from matplotlib.ticker import EngFormatter

    panel.set_title(title, fontsize="medium", parse_math=False)
    panel.set_xlabel(x, parse_math=False)
    panel.set_ylabel(y, parse_math=False)
    if not x.startswith("score"):
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)

"""A run's learning curve as a picture."""

from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError, writing
from pacesetter.files import replacing
from pacesetter.runs import Row, RunDirectory

COLOUR = "tab:blue"


def curve(run: RunDirectory, path: str | Path) -> None:
    """Draw evaluations and training episodes against the steps that all members spent."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    path, settings, rows = Path(path), run.settings(), run.rows()
    evaluations = [row for row in rows if row["kind"] == "eval"]
    if not evaluations:
        raise UsageError(f"run: {run.path} has no evaluation to draw yet")
    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
    _line(axes, evaluations)
    _dots(axes, rows)
    axes.set_title(f"{settings['env']}, {settings['name']}, seed {settings['seed']}")
    _label(axes)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    if path.suffix.removeprefix(".") not in canvas.get_supported_filetypes():
        raise UsageError(f"curve: cannot draw {path}: its name must end in .png, .svg or .pdf")
    with writing("curve", path), replacing(path) as file:
        figure.savefig(file)


def _dots(axes: Any, rows: list[Row]) -> None:
    """Episodes are logged with the next row, so a dot is at most one row's steps late."""
    ended = [(row["step"], episode[1]) for row in rows for episode in row.get("episodes_ended", [])]
    if ended:
        steps, returns = zip(*ended, strict=True)
        axes.plot(
            steps, returns, ".", color="0.6", markersize=3, zorder=1, label="training, with noise"
        )


def _line(axes: Any, evaluations: list[Row]) -> None:
    steps = [row["step"] for row in evaluations]
    low, high = ([edge(row["returns"]) for row in evaluations] for edge in (min, max))
    counts = sorted({len(row["returns"]) for row in evaluations})
    episodes = " or ".join(str(count) for count in counts)
    axes.plot(
        steps,
        [row["mean"] for row in evaluations],
        color=COLOUR,
        marker="o" if len(steps) <= 50 else None,
        markersize=3,
        label=f"mean of {episodes} evaluation episodes",
    )

    axes.fill_between(
        steps, low, high, color=COLOUR, alpha=0.2, linewidth=0, label="their lowest to highest"
    )


def _label(axes: Any) -> None:
    from matplotlib.ticker import StrMethodFormatter

    axes.set_xlabel("env steps, all members")
    axes.set_ylabel("return of an episode (sum of rewards)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:,.10g}"))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)

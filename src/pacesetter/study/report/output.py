"""A comparison written in the form that a file's name asks for."""

from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path

from pacesetter.errors import UsageError, unknown, writing
from pacesetter.files import replacing, write_atomically
from pacesetter.study.compare.groups import Comparison
from pacesetter.study.compare.results import AXES
from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report import contents, contrasts, data, paper, tables
from pacesetter.study.report.headline import headline
from pacesetter.study.report.tables import Table
from pacesetter.text import printable

PICTURES = (".png", ".svg")
SUFFIXES = (".html", ".md", ".tex", ".csv", ".json", ".pdf", *PICTURES)


@dataclass(frozen=True)
class Options:
    """What may be chosen of the output.

    `smooth` is a window of evaluations, for curves only; `axis` what a picture draws them against.
    """

    published: bool = False
    smooth: int | None = None
    axis: str | None = None
    film: bool = True
    allow: tuple[str, ...] = ()  # names of tasks that may import a module, to be filmed


def check(paths: list[str], options: Options) -> list[Path]:
    """Refuse what cannot be written before anything is computed."""
    files = [Path(path) for path in paths]
    for path in files:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"-o: {path} must end in {', '.join(SUFFIXES)}")
        if not path.parent.is_dir():
            raise UsageError(f"-o: {path.parent} is not a folder")
    if options.smooth is not None and (
        options.smooth <= SMOOTHING_ORDER or options.smooth % 2 == 0
    ):
        raise UsageError(
            f"smooth: must be an odd number of evaluations above {SMOOTHING_ORDER}, "
            f"got {options.smooth}"
        )
    if options.axis is not None:
        _check_axis(options.axis, [path.suffix for path in files])
    return files


def _check_axis(axis: str, suffixes: list[str]) -> None:
    if axis not in AXES:
        raise unknown("axis", axis, AXES)
    if not set(PICTURES).intersection(suffixes):
        raise UsageError(
            "axis: it is for the curves of a .png or .svg; give -o with one"
            " (a .html or .pdf has every axis)"
        )


def text(comparison: Comparison, options: Options) -> str:
    """For a terminal: the result, the table of the metric, what speaks against it, the ledger."""
    shown = [contents.overview(comparison), *contrasts.against(comparison)]
    shown += [contents.ledger(comparison.groups)]
    shown += paper.tables(comparison) if options.published else []
    return "\n\n".join(
        [headline(comparison), tables.plain(shown), *map(printable, comparison.notes)]
    )


def notebook(comparison: Comparison) -> str:
    """For a notebook: the result, the table of the metric and what a reader must be told."""
    words = [headline(comparison), *comparison.notes]
    found = [f"<p>{escape(line)}</p>" for line in words]
    return "\n".join([found[0], tables.grid(contents.overview(comparison), "html"), *found[1:]])


def write(comparison: Comparison, path: Path, options: Options) -> None:
    """One file; UsageError where it cannot be written."""
    with writing("-o", path):
        if path.suffix in (".pdf", *PICTURES):
            from pacesetter.study.report import figures

            picture = partial(figures.picture, axis=options.axis or "steps")
            draw = figures.pdf if path.suffix == ".pdf" else picture
            with replacing(path) as file:
                draw(comparison, file, options.smooth)
        else:
            write_atomically(path, _page(comparison, path.suffix, options).encode())


def _page(comparison: Comparison, suffix: str, options: Options) -> str:
    if suffix in (".json", ".csv"):
        return data.as_json(comparison) if suffix == ".json" else data.as_csv(comparison)
    beside = paper.tables(comparison) if options.published else []
    if suffix == ".html":
        from pacesetter.study.report.films import films
        from pacesetter.study.report.html import report

        filmed = list(films(comparison, options.allow)) if options.film else []
        return report(comparison, own(comparison), beside, filmed, options.smooth)
    write = tables.markdown if suffix == ".md" else tables.latex
    shown = [*own(comparison), *beside, contents.runs(comparison)]
    return write(contents.title(comparison), headline(comparison), comparison.notes, shown)


def own(comparison: Comparison) -> list[Table]:
    """All tables that these runs alone can fill, but that of single runs; the metric's first."""
    found = [contents.overview(comparison), *contrasts.against(comparison)]
    found += [contents.details(comparison), contents.speed(comparison)]
    found += [*contrasts.together(comparison), *contrasts.best_of_two(comparison)]
    found += [*contrasts.selections(comparison), *contrasts.settings(comparison)]
    return [*found, contents.ledger(comparison.groups)]

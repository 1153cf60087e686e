"""A comparison written in the form that a file's name asks for."""

from dataclasses import dataclass
from pathlib import Path

from pacesetter.errors import UsageError
from pacesetter.storage import write_atomically
from pacesetter.study.compare.comparison import Comparison
from pacesetter.study.compare.stats import SMOOTHING_ORDER
from pacesetter.study.report import contents, contrasts, paper, tables
from pacesetter.study.report.tables import Table

SUFFIXES = (".html", ".md", ".tex", ".pdf")


@dataclass(frozen=True)
class Options:
    """What may be chosen of the output; `smooth` is a window of evaluations, for curves only."""

    published: bool = False
    smooth: int | None = None
    film: bool = True
    allow: tuple[str, ...] = ()  # names of tasks that may import a module, to be filmed


def check(paths: list[str], options: Options) -> list[Path]:
    """Refuse what cannot be written before anything is computed."""
    for path in map(Path, paths):
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
    return [Path(path) for path in paths]


def text(comparison: Comparison, options: Options) -> str:
    """For a terminal: the table of the metric, what speaks against it, and on request the paper."""
    shown = [contents.overview(comparison), *contrasts.against(comparison)]
    shown += paper.tables(comparison) if options.published else []
    return "\n\n".join([tables.plain(shown), *comparison.notes])


def write(comparison: Comparison, path: Path, options: Options) -> None:
    """One file; UsageError where it cannot be written."""
    try:
        if path.suffix == ".pdf":
            from pacesetter.study.report.figures import pdf

            pdf(comparison, path, options.smooth)
        else:
            write_atomically(path, _page(comparison, path.suffix, options).encode())
    except OSError as error:
        raise UsageError(f"-o: cannot write {path}: {error.strerror}") from None


def _page(comparison: Comparison, suffix: str, options: Options) -> str:
    shown = everything(comparison, options)
    if suffix == ".html":
        from pacesetter.study.report.html import report

        film, allow = options.film, options.allow
        return report(comparison, shown, window=options.smooth, film=film, allow=allow)
    heading, notes = contents.title(comparison), comparison.notes
    shown.append(contents.runs(comparison))
    if suffix == ".md":
        return tables.markdown(heading, notes, shown)
    return tables.latex(heading, notes, shown)


def everything(comparison: Comparison, options: Options) -> list[Table]:
    """All tables that these runs can fill, the one of the metric first, but that of single runs."""
    found = [contents.overview(comparison), contents.details(comparison)]
    found += [contents.speed(comparison), *contrasts.against(comparison)]
    found += [*contrasts.together(comparison), *contrasts.best_of_two(comparison)]
    found += contrasts.selections(comparison)
    return found + (paper.tables(comparison) if options.published else [])

"""Tables as data, and as plain text, Markdown or LaTeX; each ends in its notes."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from tabulate import LATEX_ESCAPE_RULES, tabulate

from pacesetter.study.compare.stats import Interval
from pacesetter.text import markdown as escaped
from pacesetter.text import printable


class Cell(NamedTuple):
    """What is shown, the number it is sorted by, and the page where it is from."""

    text: str
    key: float | None = None
    url: str = ""


@dataclass(frozen=True)
class Table:
    """Headers, rows and the small print below them."""

    title: str
    headers: list[str]
    rows: list[list[Cell]]
    notes: list[str] = field(default_factory=list[str])


def word(text: object) -> Cell:
    """A cell of words."""
    return Cell(printable(str(text)))


def number(value: float, digits: int = 0, unit: str = "") -> Cell:
    """A cell of one number; `-` where there is none."""
    if np.isnan(value):
        return Cell("-")
    return Cell(f"{value:,.{digits}f}{unit}", value)  # or inf


def interval(found: Interval, digits: int = 0, after: str = "") -> Cell:
    """A cell of an estimate and its 95% interval, with words after it."""
    if np.isnan(found.value):
        return Cell("-")
    text = f"{found.value:,.{digits}f}"
    if not np.isnan(found.low):
        text += f" [{found.low:,.{digits}f}; {found.high:,.{digits}f}]"
    return Cell(text + after, found.value)


def spread(value: float, deviation: float | None, after: str = "") -> Cell:
    """A cell of a mean, its standard deviation if known, and words after it; `-` without one."""
    if np.isnan(value):
        return Cell("-")
    known = deviation is not None and not np.isnan(deviation)
    return Cell(f"{value:,.1f}{f' ± {deviation:,.1f}' if known else ''}{after}", value)


def steps(count: float) -> str:
    """Env steps as people write them: 5M, 300k, 1,234."""
    for size, letter in ((1_000_000, "M"), (1_000, "k")):
        if count >= size and count % (size / 10) == 0:
            return f"{count / size:g}{letter}"
    return f"{count:,.0f}"


def grid(table: Table, form: str, escape: Callable[[str], str] = printable) -> str:
    """Headers and rows alone, in one of tabulate's formats, which escapes LaTeX itself."""
    rows = [[escape(cell.text) for cell in row] for row in table.rows]
    headers = [escape(header) for header in table.headers]
    sides = ["right" if numeric(table, place) else "left" for place in range(len(table.headers))]
    return tabulate(rows, headers, tablefmt=form, disable_numparse=True, colalign=sides)


def numeric(table: Table, place: int) -> bool:
    """Whether a column holds numbers, which stand to the right."""
    column = [row[place] for row in table.rows]
    return any(cell.key is not None for cell in column) and all(
        cell.key is not None or cell.text == "-" for cell in column
    )


def merge(table: Table, alone: bool) -> Table:
    """Task and algorithm in one first column, which stays where a narrow screen scrolls.

    Where one task is alone the page's title names it, and the column only the algorithm.
    """
    if table.headers[:2] not in (["env", "algorithm"], ["task", "algorithm"]):
        return table
    rows = [
        [name if alone else Cell(f"{name.text} ({env.text})"), *rest]
        for env, name, *rest in table.rows
    ]
    first = "algorithm" if alone else f"algorithm ({table.headers[0]})"
    return replace(table, headers=[first, *table.headers[2:]], rows=rows)


def plain(tables: Iterable[Table]) -> str:
    """For a terminal."""
    return "\n\n".join("\n".join(_plain(table)) for table in tables)


def _plain(table: Table) -> list[str]:
    lines = [printable(table.title), "", grid(table, "plain")]
    return lines + ([""] if table.notes else []) + [printable(note) for note in table.notes]


def markdown(title: str, result: str, notes: Sequence[str], tables: Iterable[Table]) -> str:
    """A page of Markdown, whose first sentence is the result."""
    parts = [f"# {escaped(title)}", escaped(result), *([_list(notes)] if notes else [])]
    for table in tables:
        parts += [f"## {escaped(table.title)}", grid(table, "github", escaped)]
        if table.notes:
            parts.append(_list(table.notes))
    return "\n\n".join(parts) + "\n"


def _list(lines: Sequence[str]) -> str:
    return "\n".join(f"- {escaped(line)}" for line in lines)


def latex(title: str, result: str, notes: Sequence[str], tables: Iterable[Table]) -> str:
    """Tables for `\\input`; needs booktabs and graphicx."""
    parts = [f"% {printable(title)}. Needs \\usepackage{{booktabs,graphicx}}."]
    parts += [f"% {printable(line)}" for line in (result, *notes)]
    for table in tables:
        parts += ["\\begin{table}", "\\centering", f"\\caption{{{escape(table.title)}}}"]
        parts.append(_fit(grid(table, "latex_booktabs")))
        parts += [f"\n\\footnotesize {escape(' '.join(table.notes))}"] if table.notes else []
        parts.append("\\end{table}\n")
    return "\n".join(parts)


def _fit(tabular: str) -> str:
    body = tabular.replace("±", "$\\pm$")
    return (
        f"\\resizebox{{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}}{{!}}{{%\n{body}}}"
    )


def count(value: float) -> Cell:
    """A cell of a number of env steps."""
    return Cell(steps(value), value)


def escape(text: str) -> str:
    """Words as LaTeX."""
    plain = "".join(LATEX_ESCAPE_RULES.get(letter, letter) for letter in printable(text))
    return plain.replace("±", "$\\pm$")

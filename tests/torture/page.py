"""The table of docs/reliability.md: a row per experiment, each with the day when it was made."""

import fcntl
import re
from collections.abc import Iterable
from datetime import date
from pathlib import Path

BEGIN, END = "<!-- torture: written by tests/torture/run.py -->", "<!-- end of torture -->"
HEAD = ["| experiment | target | came out | met | made on |", "|---|---|---|---|---|"]
_MARKED = re.compile(f"{re.escape(BEGIN)}(.*){re.escape(END)}", re.DOTALL)


def row(what: str, target: str, came_out: str, met: bool) -> str:
    """One line of the table, of today."""
    cells = (what, target, came_out, "yes" if met else "NO", str(date.today()))
    return f"| {' | '.join(cells)} |"


def write(file: Path, new: str, order: Iterable[str]) -> None:
    """Put one row into the page's table; the others stay, but for experiments not in `order`."""
    with open(file, "r+", encoding="utf-8") as page:
        fcntl.flock(page, fcntl.LOCK_EX)  # experiments may end at the same time
        text = _with(page.read(), new, order)
        page.seek(0)
        page.write(text)
        page.truncate()


def _with(text: str, new: str, order: Iterable[str]) -> str:
    found = _MARKED.search(text)
    if found is None:
        raise ValueError(f"no table between {BEGIN} and {END}")
    rows = {_what(line): line for line in found[1].splitlines() if line.startswith("| ")}
    rows |= {_what(new): new}
    lines = [*HEAD, *(rows[what] for what in order if what in rows)]
    table = "\n".join([BEGIN, "", *lines, "", END])
    return text[: found.start()] + table + text[found.end() :]


def _what(line: str) -> str:
    return line.split(" | ")[0].removeprefix("| ")

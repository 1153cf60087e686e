"""Run the experiments and write what came out into docs/reliability.md, between its two markers.

`python tests/torture/run.py` takes minutes, with `--long` an hour; `make torture` calls it.
"""

import argparse
import re
import sys
import tempfile
import warnings
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

import configurations  # noqa: E402
import odd_files  # noqa: E402
import processes  # noqa: E402
import swapped  # noqa: E402
from attempts import Tally  # noqa: E402

PAGE = ROOT / "docs" / "reliability.md"
BEGIN, END = "<!-- torture: written by tests/torture/run.py -->", "<!-- end of torture -->"


class Experiment(NamedTuple):
    """What is done, what must come out, and how often it is done for minutes and for an hour."""

    what: str
    target: str
    make: Callable[[Path, int], Tally]
    short: int
    long: int
    told: Callable[[Tally], str] = Tally.table


def _odd(folder: Path, size: int) -> Tally:
    return odd_files.run(folder, odd_files.KINDS, size // len(odd_files.KINDS))


TARGET = "0 tracebacks, 0 code run, under 100 MB and 1 CPU second each"
EXPERIMENTS = (
    Experiment("configurations made at random", TARGET, configurations.run, 1_000, 10_000),
    Experiment("files of eight kinds with one odd thing each", TARGET, _odd, 1_600, 10_000),
    Experiment(
        "a run's files cut, flipped, emptied, swapped, or a folder, a link, a FIFO",
        "a whole checkpoint is taken up, or one line; " + TARGET,
        swapped.run,
        100,
        300,
    ),
    Experiment(
        "SIGKILL at random moments: four learners, checkpoints twice a second",
        "every checkpoint whole, no step lost beyond the last; ends as if undisturbed; no litter",
        processes.kills,
        10,
        200,
        Tally.of_processes,
    ),
    Experiment(
        "INT, TERM, HUP, USR1 at random moments, start-up included",
        "saved once there is something to save, gone in 10 s, the code of the signal",
        processes.signals,
        12,
        200,
        Tally.of_processes,
    ),
)


def table(rows: list[tuple[Experiment, Tally]]) -> str:
    """The rows as Markdown, with the day."""
    cells = [
        (each.what, each.target, each.told(tally), "yes" if tally.passed else "NO")
        for each, tally in rows
    ]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    head = ["| experiment | target | came out | met |", "|---|---|---|---|"]
    return "\n".join([f"Made on {date.today()}:", "", *head, *lines])


def main() -> int:
    """Exit code 1 if a target was missed."""
    command = argparse.ArgumentParser(description=__doc__)
    command.add_argument("--long", action="store_true", help="the sizes of the targets")
    long = command.parse_args().long
    rows: list[tuple[Experiment, Tally]] = []
    warnings.simplefilter("ignore")
    for each in EXPERIMENTS:
        with tempfile.TemporaryDirectory() as folder:
            tally = each.make(Path(folder), each.long if long else each.short)
        print(f"{each.what}: {each.told(tally)}", *tally.wrong[:20], sep="\n  ", flush=True)
        rows.append((each, tally))
    marked = re.compile(f"{re.escape(BEGIN)}.*{re.escape(END)}", re.DOTALL)
    text = f"{BEGIN}\n\n{table(rows)}\n\n{END}"
    PAGE.write_text(marked.sub(lambda _: text, PAGE.read_text()))
    return 0 if all(tally.passed for _, tally in rows) else 1


if __name__ == "__main__":
    sys.exit(main())

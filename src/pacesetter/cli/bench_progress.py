"""Progress of all runs of a bench on stderr: bars on a terminal, plain lines elsewhere."""

import json
import os
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pacesetter.cli.progress import Pace, bars
from pacesetter.errors import tell
from pacesetter.files import regular
from pacesetter.runs import Row, RunDirectory
from pacesetter.storage import FAULTS
from pacesetter.study.bench.queue import Bench
from pacesetter.study.bench.suite import Job

if TYPE_CHECKING:
    from rich.progress import Progress

Show = Callable[[Bench], None]
TAIL = 2**18  # bytes of a log in which its last evaluation is looked for
LOOK_EVERY = 1.0  # seconds
LOOKS = 600  # over which the speed is taken
LINE_EVERY = 300.0  # seconds between lines that say how far all is


@contextmanager
def display(bench: Bench, quiet: bool = False) -> Generator[Show]:
    """What shows how far a bench is, each time it is called with it."""
    if quiet:
        yield _waits()
    elif sys.stderr.isatty():
        with _bars(bench) as show:
            yield show
    else:
        yield _lines(bench)


def _waits() -> Show:
    """Name only the runs that wait for another process, without which a bench may not end."""
    told: set[str] = set()

    def show(bench: Bench) -> None:
        for name in bench.aside.keys() - told:
            told.add(name)
            tell(f"{name}: in use by {bench.aside[name]}")

    return show


class _Total:
    """Env steps of all runs that have not failed, and the time left at the speed of late."""

    def __init__(self, bench: Bench) -> None:
        self._budgets = {str(job): job.config.budget for job in bench.jobs}
        self._steps = {str(job): _last(job.directory)[0] for job in bench.left}
        self._pace = Pace(self._count(bench)[0], time.monotonic(), LOOKS)

    def _count(self, bench: Bench) -> tuple[int, int]:
        for job, _, _ in bench.running.values():
            self._steps[str(job)] = _last(job.directory)[0]
        self._steps |= {str(job): self._budgets[str(job)] for job in bench.finished}
        counted = self._budgets.keys() - bench.failed.keys()
        done = sum(min(self._steps[name], self._budgets[name]) for name in counted)
        return done, sum(self._budgets[name] for name in counted)

    def read(self, bench: Bench) -> tuple[int, int, str]:
        """Steps made, steps in all, and the time left as text."""
        done, total = self._count(bench)
        return done, total, self._pace.read(done, time.monotonic(), total)[1]


def _lines(bench: Bench) -> Show:
    steps, printed_at = _Total(bench), time.monotonic()

    def show(bench: Bench) -> None:
        nonlocal printed_at
        late = time.monotonic() - printed_at > LINE_EVERY
        for line in bench.news or ([""] if late else []):
            printed_at = time.monotonic()
            done, total, left = steps.read(bench)
            state = f"{len(bench.finished)} of {len(bench.jobs)} runs  "
            state += f"step {done:,} of {total:,}  ETA {left}"
            print(f"{line}  [{state}]" if line else state, file=sys.stderr, flush=True)
        bench.news.clear()

    return show


@contextmanager
def _bars(bench: Bench) -> Generator[Show]:
    steps, looked = _Total(bench), 0.0
    rows: dict[str, Any] = {}  # a bar for each job that runs
    from rich.progress import TextColumn

    with bars(TextColumn("{task.fields[note]}")) as shown:
        whole = shown.add_task("all runs", total=steps.read(bench)[1], note="")

        def show(bench: Bench) -> None:
            nonlocal looked
            for line in bench.news:
                shown.console.print(line, highlight=False, markup=False)
            bench.news.clear()
            if time.monotonic() - looked < LOOK_EVERY:
                return
            looked = time.monotonic()
            done, total, left = steps.read(bench)
            note = f"{len(bench.finished)} of {len(bench.jobs)} runs  ETA {left}"
            shown.update(whole, completed=done, total=total, note=note)
            _update_rows(shown, rows, {str(job): job for job, _, _ in bench.running.values()})

        yield show


def _update_rows(shown: "Progress", rows: dict[str, Any], running: dict[str, Job]) -> None:
    for name in rows.keys() - running.keys():
        shown.remove_task(rows.pop(name))
    for name, job in running.items():
        if name not in rows:
            rows[name] = shown.add_task(name, total=job.config.budget, note="")
        step, result = _last(job.directory)
        shown.update(rows[name], completed=step, note=f"return {result}")


def _last(directory: RunDirectory) -> tuple[int, str]:
    """The step of a log's last whole line, and its last evaluation's return as text."""
    try:
        with open(directory.metrics_file, "rb", opener=regular) as file:
            file.seek(-min(TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return 0, "-"
    step, result = 0, "-"
    for line in reversed(lines):
        try:
            row: Row = json.loads(line)
            step = step or int(row["step"])
            if row["kind"] == "eval":
                result = f"{row['mean']:.1f}"
                break
        except FAULTS:  # its beginning is missing, or it is no row of ours
            break
    return step, result

"""One progress display for all runs of a bench, on stderr: bars on a terminal, lines elsewhere."""

import json
import os
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import timedelta

from pacesetter.runs import Row, RunDirectory
from pacesetter.study.bench.queue import Bench
from pacesetter.study.bench.suite import Job

Show = Callable[[Bench], None]
TAIL = 2**18  # bytes of a log in which its last evaluation is looked for
LOOK_EVERY = 1.0  # seconds
LINE_EVERY = 300.0  # seconds between lines that say how far all is


@contextmanager
def display(bench: Bench, quiet: bool = False) -> Generator[Show]:
    """What shows a bench whenever it is called with it."""
    if quiet:
        yield lambda bench: None
    elif sys.stderr.isatty():
        with _bars(bench) as show:
            yield show
    else:
        yield _lines(bench)


class _Pace:
    """Env steps of all runs that have not failed, and the time left at the speed so far."""

    def __init__(self, bench: Bench) -> None:
        self._budgets = {str(job): _budget(job) for job in bench.jobs}
        self._steps = {str(job): _last(job.directory)[0] for job in bench.left}
        self._began = time.monotonic()
        self._first = self.read(bench)[0]

    def read(self, bench: Bench) -> tuple[int, int, str]:
        """Steps made, steps in all, and the time left as text."""
        for job, _, _ in bench.running.values():
            self._steps[str(job)] = _last(job.directory)[0]
        self._steps |= {str(job): self._budgets[str(job)] for job in bench.finished}
        counted = self._budgets.keys() - bench.failed.keys()
        done = sum(min(self._steps[name], self._budgets[name]) for name in counted)
        total = sum(self._budgets[name] for name in counted)
        return done, total, self._left(done, total)

    def _left(self, done: int, total: int) -> str:
        made = done - getattr(self, "_first", done)
        if made <= 0:
            return "-"
        seconds = (time.monotonic() - self._began) * (total - done) / made
        return str(timedelta(seconds=round(seconds)))


def _lines(bench: Bench) -> Show:
    pace = _Pace(bench)
    said = time.monotonic()

    def show(bench: Bench) -> None:
        nonlocal said
        late = time.monotonic() - said > LINE_EVERY
        for line in bench.news or ([""] if late else []):
            said = time.monotonic()
            done, total, left = pace.read(bench)
            state = f"{len(bench.finished)} of {len(bench.jobs)} runs  "
            state += f"step {done:,} of {total:,}  ETA {left}"
            print(f"{line}  [{state}]" if line else state, file=sys.stderr, flush=True)
        bench.news.clear()

    return show


@contextmanager
def _bars(bench: Bench) -> Generator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn

    pace, looked = _Pace(bench), 0.0
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=2) as bar:
        whole = bar.add_task("all runs", total=pace.read(bench)[1], note="")
        rows: dict[str, TaskID] = {}

        def show(bench: Bench) -> None:
            nonlocal looked
            for line in bench.news:
                bar.console.print(line, highlight=False, markup=False)
            bench.news.clear()
            if time.monotonic() - looked < LOOK_EVERY:
                return
            looked = time.monotonic()
            done, total, left = pace.read(bench)
            note = f"{len(bench.finished)} of {len(bench.jobs)} runs  ETA {left}"
            bar.update(whole, completed=done, total=total, note=note)
            running = {str(job): job for job, _, _ in bench.running.values()}
            for name in rows.keys() - running.keys():
                bar.remove_task(rows.pop(name))
            for name, job in running.items():
                if name not in rows:
                    rows[name] = bar.add_task(name, total=_budget(job), note="")
                step, result = _last(job.directory)
                bar.update(rows[name], completed=step, note=f"return {result}")

        yield show


def _budget(job: Job) -> int:
    return job.config.run.steps * job.config.steps_per_count


def _last(directory: RunDirectory) -> tuple[int, str]:
    """Step of a log's last whole row, and its last return as text."""
    try:
        with directory.metrics_file.open("rb") as file:
            file.seek(-min(TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return 0, "-"
    step, result = 0, "-"
    for line in reversed(lines):
        try:
            row: Row = json.loads(line)
        except ValueError:  # cut at its beginning
            break
        step = step or row["step"]
        if row["kind"] == "eval":
            result = f"{row['mean']:.1f}"
            break
    return step, result

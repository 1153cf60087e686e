"""Where reports go besides the log: a progress bar on a terminal, plain lines elsewhere."""

import sys
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pacesetter.training.trainer import Report, Trainer

Sink = Callable[["Report"], None]


@contextmanager
def console(trainer: "Trainer", quiet: bool = False) -> Generator[Sink]:
    """A sink for reports: a bar with steps/s, ETA and last return, or a line an evaluation."""
    if quiet:
        yield lambda report: None
    elif sys.stderr.isatty():
        with _bar(trainer) as sink:
            yield sink
    else:
        yield _lines(trainer)


class _Pace:
    """Speed over the last reports and what is left of both budgets."""

    def __init__(self, trainer: "Trainer") -> None:
        self.trainer = trainer
        start = (trainer.progress.step, trainer.progress.wall_seconds)
        self.marks = deque([start], maxlen=10)

    def read(self, report: "Report") -> tuple[float, str]:
        """Steps a second and the time left as text."""
        seconds = report.ledger["wall_seconds"]
        self.marks.append((report.step, seconds))
        first_step, first_seconds = self.marks[0]
        speed = (report.step - first_step) / max(seconds - first_seconds, 1e-9)
        left = (self.trainer.budget - report.step) / max(speed, 1e-9) if report.step else 0.0
        limit = self.trainer.config.run.time
        if limit is not None:
            left = min(left, max(limit - seconds, 0.0))
        known = report.step > first_step
        return speed, str(timedelta(seconds=round(left))) if known else "-"


def _lines(trainer: "Trainer") -> Sink:
    pace = _Pace(trainer)

    def show(report: "Report") -> None:
        speed, left = pace.read(report)
        if report.kind == "eval":
            values = report.values
            print(
                f"step {report.step:,}  return {values['mean']:.1f} +- {values['std']:.1f}  "
                f"{speed:.0f} steps/s  ETA {left}",
                file=sys.stderr,
                flush=True,
            )

    return show


@contextmanager
def _bar(trainer: "Trainer") -> Generator[Sink]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    pace, run = _Pace(trainer), trainer.config.run
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]} steps/s  ETA {task.fields[left]}"),
        TextColumn("return {task.fields[result]}"),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=2) as bar:
        task = bar.add_task(
            f"{run.env} {run.name} {run.seed}",
            total=trainer.budget,
            completed=trainer.progress.step,
            speed="-",
            left="-",
            result="-",
        )

        def show(report: "Report") -> None:
            speed, left = pace.read(report)
            bar.update(task, completed=report.step, speed=f"{speed:.0f}", left=left)
            if report.kind == "eval":
                bar.update(task, result=f"{report.values['mean']:.1f}")

        yield show

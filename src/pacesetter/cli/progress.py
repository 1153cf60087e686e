"""Progress on stderr: bars on a terminal, plain lines elsewhere. Here, of one run."""

import sys
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import timedelta
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

    from pacesetter.training.trainer import Report, Trainer

Sink = Callable[["Report"], None]


class Pace:
    """Steps per second over the last looks, and the time left at that speed."""

    def __init__(self, step: int, seconds: float, looks: int) -> None:
        self._marks = deque([(step, seconds)], maxlen=looks)

    def read(self, step: int, seconds: float, total: int, most: float = inf) -> tuple[float, str]:
        """Speed, and the time until `total` steps but `most` seconds; `-` before the first step."""
        self._marks.append((step, seconds))
        first_step, first_seconds = self._marks[0]
        speed = (step - first_step) / max(seconds - first_seconds, 1e-9)
        if speed <= 0:
            return 0.0, "-"
        left = min((total - step) / speed, max(most, 0.0))
        return speed, str(timedelta(seconds=round(left)))


def bars() -> "Progress":
    """Bars on stderr: a name, how far it is, and a `note`."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
        TextColumn("{task.fields[note]}"),
    )
    return Progress(*columns, console=Console(stderr=True), refresh_per_second=2)


@contextmanager
def console(trainer: "Trainer", quiet: bool = False) -> Generator[Sink]:
    """Show a run's reports: on a terminal as a bar, elsewhere as one line per evaluation."""
    if quiet:
        yield lambda report: None
    elif sys.stderr.isatty():
        with _bar(trainer) as sink:
            yield sink
    else:
        yield _lines(trainer)


def _speed(trainer: "Trainer") -> Callable[["Report"], str]:
    """What says a run's speed and the time left, by its budget of steps and of time."""
    progress, limit = trainer.progress, trainer.config.run.time or inf
    pace = Pace(progress.step, progress.wall_seconds, looks=10)

    def read(report: "Report") -> str:
        seconds = report.ledger["wall_seconds"]
        speed, left = pace.read(report.step, seconds, trainer.budget, limit - seconds)
        return f"{speed:.0f} steps/s  ETA {left}"

    return read


def _lines(trainer: "Trainer") -> Sink:
    read = _speed(trainer)

    def show(report: "Report") -> None:
        speed = read(report)
        if report.kind == "eval":
            result = f"return {report.values['mean']:.1f} +- {report.values['std']:.1f}"
            line = f"step {report.step:,}  {result}  {speed}"
            print(line, file=sys.stderr, flush=True)

    return show


@contextmanager
def _bar(trainer: "Trainer") -> Generator[Sink]:
    read, run, result = _speed(trainer), trainer.config.run, "-"
    with bars() as shown:
        name, step = f"{run.env} {run.name} {run.seed}", trainer.progress.step
        task = shown.add_task(name, total=trainer.budget, completed=step, note="")

        def show(report: "Report") -> None:
            nonlocal result
            if report.kind == "eval":
                result = f"{report.values['mean']:.1f}"
            note = f"{read(report)}  return {result}"
            shown.update(task, completed=report.step, note=note)

        yield show

"""Progress on stderr: bars on a terminal, plain lines elsewhere. Here, of one run."""

import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from datetime import timedelta
from math import inf
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from pacesetter.cli.advice import Slowness

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

    from pacesetter.training.trainer import Report, Trainer

Sink = Callable[["Report"], None]
LOOK_EVERY = 0.5  # seconds
LOOKS = 240  # over which the speed is taken
SHOWN_MEMBERS = 8


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
        return speed, _time(left)


def _time(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))


def bars(*more: "ProgressColumn") -> "Progress":
    """Bars on stderr, as wide as the terminal: a name, how far it is, other columns, and below them
    what a task says `below`.
    """
    from rich.console import Console, RenderableType
    from rich.progress import BarColumn, Progress, TextColumn
    from rich.text import Text

    class Bars(Progress):
        def get_renderables(self) -> Iterable[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            # Text wraps where the terminal is narrow; a column would be cut.
            yield from (Text(task.fields["below"]) for task in self.tasks if "below" in task.fields)

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
    )
    console = Console(stderr=True)
    return Bars(*columns, *more, console=console, refresh_per_second=2, expand=True)


class View:
    """How a run stands, read off its counters at any moment and off its reports."""

    def __init__(self, trainer: "Trainer") -> None:
        self._trainer, self._limit = trainer, trainer.config.run.time or inf
        self._warmup = int(getattr(trainer.config.hyper, "warmup", 0))
        self._began = time.monotonic() - trainer.progress.wall_seconds
        self._phase, self._pace = "", self._new_pace()
        best = trainer.progress.best  # a resumed run has one
        self._last, self._best = "-", "-" if best is None else f"{best:,.1f}"
        self._returns: dict[int, float] = {}  # of each member's last training episode

    def take(self, report: "Report") -> None:
        """Keep what a report says that no counter does."""
        self._note(report.values.get("episodes_ended", []))
        if report.kind == "eval":
            self._last = f"{report.values['mean']:,.1f}"
            best = self._trainer.progress.best
            self._best = self._last if best is None else f"{best:,.1f}"

    def _note(self, episodes: list[list[float]]) -> None:
        self._returns |= {int(member): total for member, total, _ in episodes}

    @property
    def phase(self) -> str:
        """What the run is doing."""
        progress = self._trainer.progress
        if progress.next_evaluation <= progress.step < self._trainer.budget:
            return "evaluating"
        return "warm-up" if progress.step < self._warmup else "training"

    def _new_pace(self) -> Pace:
        return Pace(self._trainer.progress.step, time.monotonic(), LOOKS)

    def speed(self) -> str:
        """Time so far and left, and the speed, each phase by its own."""
        step, now, phase = self._trainer.progress.step, time.monotonic(), self.phase
        if phase != self._phase and "evaluating" not in (phase, self._phase):
            self._pace = self._new_pace()
        self._phase = phase if phase != "evaluating" else self._phase
        most = self._limit - (now - self._began)
        speed, left = self._pace.read(step, now, self._trainer.budget, most)
        left = left if step >= self._warmup else "after the warm-up"
        shown = f"{speed:,.1f}" if speed else "-"
        return f"{_time(now - self._began)} elapsed  ETA {left}  {shown} steps/s"

    def returns(self) -> str:
        """The last and the best evaluation, and each member's last training return."""
        self._note(list(self._trainer.progress.ended))
        text = f"return {self._last} (best {self._best})"
        shown = [f"{value:,.1f}" for _, value in sorted(self._returns.items())]
        if len(shown) > SHOWN_MEMBERS:
            shown = [*shown[:SHOWN_MEMBERS], "..."]
        return f"{text}  in training {' | '.join(shown)}" if shown else text


@contextmanager
def console(trainer: "Trainer", quiet: bool = False) -> Generator[Sink]:
    """Show a run's reports: on a terminal as a bar, elsewhere as one line per evaluation."""
    if quiet:
        yield lambda report: None
        return
    view, slow = View(trainer), Slowness(trainer)
    with (_bar if sys.stderr.isatty() else _lines)(trainer, view) as (show, look, say):

        def look_at_all() -> None:
            if warning := slow.look(time.monotonic()):
                say(f"pacesetter: {warning}")
            look()

        def take(report: "Report") -> None:
            view.take(report)
            show(report)

        with _often(look_at_all):
            yield take


@contextmanager
def _often(look: Callable[[], None]) -> Generator[None]:
    """Look while the run trains, since a report may be long in coming."""
    ended = Event()

    def watch() -> None:
        while not ended.wait(LOOK_EVERY):
            look()

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@contextmanager
def _lines(trainer: "Trainer", view: View) -> Generator[Any]:
    def show(report: "Report") -> None:
        speed = view.speed()
        if report.kind == "eval":
            result = f"return {report.values['mean']:.1f} +- {report.values['std']:.1f}"
            _say(f"step {report.step:,} of {trainer.budget:,}  {view.phase}  {result}  {speed}")

    yield show, view.speed, _say


@contextmanager
def _bar(trainer: "Trainer", view: View) -> Generator[Any]:
    run = trainer.config.run
    with bars() as shown:
        name, step = f"{run.env} {run.name} {run.seed}", trainer.progress.step
        task = shown.add_task(name, total=trainer.budget, completed=step, below="")

        def look() -> None:
            below = f"{view.phase}  {view.speed()}\n{view.returns()}"
            shown.update(task, completed=trainer.progress.step, below=below)

        def say(line: str) -> None:
            shown.console.print(line, highlight=False, markup=False)

        look()
        yield lambda report: look(), look, say
        look()

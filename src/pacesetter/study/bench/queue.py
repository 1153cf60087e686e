"""Run jobs to their end, each as its own command: skip finished ones, resume broken ones.

Progress is read from the runs' folders alone. A bench that was stopped or killed is therefore
started again, and several may work on one folder: the lock of a run's folder decides who has it.
"""

import shlex
import time
from collections import Counter, deque
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

from pacesetter import files, storage
from pacesetter.ensemble.progress import Progress
from pacesetter.errors import InUseError, UsageError
from pacesetter.process import CODES
from pacesetter.settings.budget import is_spent
from pacesetter.study.bench.suite import Job

RETRIES = 2
# Exit codes of `train` and `resume`.
BAD_INPUT, IN_USE, SAVED = UsageError.code, InUseError.code, {*CODES.values()}
POLL = 0.2  # seconds
ALONE = {"NPROC": "1", "OMP_NUM_THREADS": "1"}  # one thread per run: results never depend on --jobs


class Outcome(NamedTuple):
    """How a command ended: its exit code, minus the signal if killed, and all that it printed."""

    code: int
    output: str


class Executor(Protocol):
    """Where commands run; a task is whatever `start` gives."""

    slots: int

    def start(self, slot: int, words: list[str]) -> Any:
        """Begin `pacesetter WORDS`."""
        ...

    def poll(self, task: Any) -> Outcome | None:
        """How it ended, None while it runs."""
        ...

    def stop(self, task: Any) -> None:
        """Ask it to save and end."""
        ...

    def kill(self, task: Any) -> None:
        """End it now, with all that it has started."""
        ...


def is_finished(job: Job) -> bool:
    """Whether the newest checkpoint has spent the job's budget and been evaluated there."""
    try:
        table = storage.read(job.directory.state_file, "checkpoint").table
        progress = Progress.load(table["progress"])
    except (UsageError, *storage.FAULTS):
        return False  # nothing yet, or damaged, which `resume` deals with
    run, standing = vars(job.config.run), progress.standing
    spent = is_spent(run, progress.step, progress.wall_seconds, standing)
    return spent and progress.last_evaluation == progress.step


def words_of(job: Job) -> list[str]:
    """The command that continues a run: `resume` if its folder holds one, else `train`."""
    if files.present(job.directory.config_file):
        return [*job.directory.resume_words(job.config), *job.always, "-q"]
    return [*job.words, *job.always, "-q"]


def damaged(jobs: list[Job]) -> dict[str, str]:
    """Jobs whose folder holds a run that cannot be read, and why; UsageError for another run."""
    found: dict[str, str] = {}
    for job in jobs:
        try:
            other = job.directory.difference_from(job.config)
        except UsageError as error:
            found[str(job)] = str(error)
            continue
        if other:
            raise UsageError(
                f"run: {job.directory.path} exists with {other}; "
                "give other --runs, or the entry another name"
            )
    return found


class Bench:
    """All jobs and where they are; refuses a folder that holds another run."""

    def __init__(self, jobs: list[Job]) -> None:
        self.jobs = jobs
        self.failed = damaged(jobs)
        self.news = [f"{name}: failed for good, {why}" for name, why in self.failed.items()]
        whole = [job for job in jobs if str(job) not in self.failed]
        done = [is_finished(job) for job in whole]
        self.finished = [job for job, over in zip(whole, done, strict=True) if over]
        self.before = len(self.finished)
        self.running: dict[int, tuple[Job, Any, list[str]]] = {}
        self._waiting = deque(job for job, over in zip(whole, done, strict=True) if not over)
        self._failures: Counter[str] = Counter()
        self.aside: dict[str, str] = {}  # who holds the runs that wait for another process
        self._stopping = False

    def stop(self) -> None:
        """Ask for the end once the running jobs have saved; may be called from a handler."""
        self._stopping = True

    def kill(self, executor: Executor) -> None:
        """End the running jobs where they are; may be called from a handler."""
        for _, task, _ in [*self.running.values()]:
            executor.kill(task)

    def check_envs(self) -> None:
        """Refuse a task that cannot be made, before anything starts."""
        recipes = {str(recipe): recipe for recipe in (job.config.recipe for job in self.left)}
        for recipe in recipes.values():
            recipe.make().close()

    def run(self, executor: Executor) -> Iterator[None]:
        """Run until all have finished, failed or, after `stop`, saved; yields at each poll."""
        stopped = False
        try:
            while self._waiting or self.running:
                if self._stopping and not stopped:
                    stopped = True
                    self._waiting.clear()
                    self._stop_all(executor)
                self._poll(executor, stopped)
                self._start(executor)
                yield
                time.sleep(POLL)
        finally:
            self._stop_all(executor)

    def _stop_all(self, executor: Executor) -> None:
        for _, task, _ in self.running.values():
            executor.stop(task)

    @property
    def left(self) -> list[Job]:
        """Jobs that neither run nor have ended; some may be in use by another process."""
        return list(self._waiting)

    def _start(self, executor: Executor) -> None:
        for slot in set(range(executor.slots)) - self.running.keys():
            for _ in range(len(self._waiting)):
                job = self._waiting.popleft()
                if holder := job.directory.holder():  # another bench, or the run of a killed one
                    self._set_aside(job, holder)
                elif is_finished(job):
                    self._finish(job)
                else:
                    words = words_of(job)
                    self.running[slot] = job, executor.start(slot, words), words
                    self.news.append(f"{job}: {words[0]}")
                    break

    def _poll(self, executor: Executor, stopped: bool) -> None:
        for slot, (job, task, words) in list(self.running.items()):
            outcome = executor.poll(task)
            if outcome is not None:
                del self.running[slot]
                self._end(job, words, outcome, stopped)

    def _end(self, job: Job, words: list[str], outcome: Outcome, stopped: bool) -> None:
        overtaken = words[0] == "train" and files.present(job.directory.config_file)
        holder = job.directory.holder() if outcome.code == IN_USE else None
        if is_finished(job):
            self._finish(job)
        elif stopped:
            self.news.append(f"{job}: stopped")
        elif outcome.code in SAVED:
            self._waiting.append(job)
        elif holder or (outcome.code == BAD_INPUT and overtaken):
            self._set_aside(job, holder or "another process")
        elif outcome.code == BAD_INPUT or self._failures[str(job)] == RETRIES:
            self._fail(job, words, outcome)
        else:
            self._failures[str(job)] += 1
            self._waiting.append(job)
            self.news.append(f"{job}: failed, {_last_line(outcome)}; trying again")

    def _set_aside(self, job: Job, holder: str) -> None:
        self._waiting.append(job)
        if str(job) not in self.aside:
            self.aside[str(job)] = holder
            self.news.append(f"{job}: in use by {holder}; will retry when it is free")

    def _finish(self, job: Job) -> None:
        self.finished.append(job)
        self.news.append(f"{job}: finished")

    def _fail(self, job: Job, words: list[str], outcome: Outcome) -> None:
        file, text = job.directory.path / "failure.log", f"$ {shlex.join(words)}\n{outcome.output}"
        try:
            if file.parent.is_dir():
                files.write_atomically(file, text.encode(errors="backslashreplace"))
        except OSError as error:  # no reason to give up the others
            self.news.append(f"{job}: cannot write {file}: {error.strerror}")
        self.failed[str(job)] = _last_line(outcome)
        self.news.append(f"{job}: failed for good, {_last_line(outcome)}")


def _last_line(outcome: Outcome) -> str:
    *_, last = ["", *(line for line in outcome.output.splitlines() if line.strip())]
    return f"exit {outcome.code}: {last.removeprefix('pacesetter: ')}".rstrip(": ")

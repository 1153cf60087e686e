"""A run from first to last step: an iterator of reports that can stop and go on anywhere."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, Unpack, overload

from pacesetter.config import resolve
from pacesetter.consent import require_all
from pacesetter.ensemble.loop import Loop
from pacesetter.ensemble.members import Members
from pacesetter.ensemble.progress import Progress
from pacesetter.envs import apart
from pacesetter.envs.tasks import Factory, name_of
from pacesetter.errors import TaskError, TrainingError, UsageError, told
from pacesetter.learner import products
from pacesetter.learner.backend import device_faults, made_with, prepare
from pacesetter.policy import Policy
from pacesetter.runs import RunDirectory, find
from pacesetter.settings import OnPolicy
from pacesetter.settings.budget import is_settled, out_of_time
from pacesetter.settings.files import read_file
from pacesetter.training import checkpoint, identity
from pacesetter.training.evaluator import Evaluator
from pacesetter.training.on_policy import OnPolicyLoop
from pacesetter.training.report import Report
from pacesetter.training.reporter import Reporter
from pacesetter.training.starting import start_from
from pacesetter.training.tasks import closed_by_a_fault, make_tasks

if TYPE_CHECKING:
    from pacesetter.settings.typed import Name, TrainerSettings


class Trainer:
    """A run, new or resumed: iterate over it to train, break to stop; it goes on with `resume`."""

    @overload
    def __init__(
        self, algorithm: "Name", env: str | Factory, **settings: "Unpack[TrainerSettings]"
    ) -> None: ...

    @overload  # presets and algorithms of other people
    def __init__(self, algorithm: str, env: str | Factory, **settings: Any) -> None: ...

    @device_faults()
    def __init__(
        self,
        algorithm: str,
        env: str | Factory,
        *,
        runs: str | Path = "runs",
        config: str | Path | None = None,
        **settings: Any,
    ) -> None:
        """Check everything, then make the run's folder below `runs`.

        `env` is an id, or a function that gives a new env at each call. `settings` are those of
        `pacesetter train ALGO ENV --help`; `config` is a file of them.
        """
        layers = [read_file(Path(config), algorithm)] if config else []
        if layers and "wrap" not in settings:
            require_all("wrap", layers[0].get("wrap", ()), flag="--wrap")
        self.config = resolve(algorithm, name_of(env), *layers, settings)
        self.directory = RunDirectory.of(runs, self.config)
        self.directory.refuse_existing(self.config)
        self.notes = prepare(self.config.run.device)
        self._begin(None, env)
        with closed_by_a_fault([self]):
            start_from(self.loop, self.config, runs)
            self.directory.create(self.config, **self._made_with)
            try:
                self.loop.open_replays(self.directory.state_file.parent)
                checkpoint.save(self.loop, self.config, self.directory)
            except BaseException:
                self.directory.remove()
                raise
        self.notes += [*self.directory.notes, *products.notes(self.config.hyper)]

    @classmethod
    @device_faults()
    def resume(
        cls,
        run: str | Path,
        *,
        runs: str | Path = "runs",
        steps: int | str | None = None,
        time: float | str | None = None,
        stop_at: float | None = None,
        stop_patience: int | None = None,
        env_timeout: float | str | None = None,
        checkpoint_every: float | str | None = None,
        device: str | None = None,
        allow: Iterable[str] = (),
        env: Factory | None = None,
    ) -> Self:
        """Take up a run where its last checkpoint left it, with what is given anew.

        `allow` are names in its config that may import a module; `env` is the function that made
        its envs, if one did.
        """
        self = cls.__new__(cls)
        self.directory = find(str(run), runs)
        self.config = identity.with_new(
            self.directory.config(allow),
            steps=steps,
            time=time,
            stop_at=stop_at,
            stop_patience=stop_patience,
            env_timeout=env_timeout,
            checkpoint_every=checkpoint_every,
            device=device,
        )
        identity.refuse_other_settings(self.config, self.directory)
        self.notes = prepare(self.config.run.device)
        self._begin(apart.recorded(self.directory.record()), env)
        with closed_by_a_fault([self]):
            self.directory.lock()
            self.directory.sweep()
            self.loop.open_replays(self.directory.state_file.parent)
            begun = self.directory.has_checkpoint
            notes = checkpoint.restore(self.loop, self.config, self.directory)
            if not begun:
                start_from(self.loop, self.config, runs)
            self.notes += identity.device_notes(self.directory, self._made_with["backend"])
            self.notes += [*self.directory.notes, *notes]
            if self.progress.step > self.budget:
                raise UsageError(f"steps: the run has made {self.progress.step:,}; give more")
            self.directory.note_resume(self.config, self.progress.step, **self._made_with)
        return self

    def __repr__(self) -> str:
        run = self.config.run
        done = f"{self.progress.step:,} of {self.budget:,} steps"
        return f"Trainer({run.name} on {run.env}, seed {run.seed}: {done}, {self.directory.path})"

    def _begin(self, before: apart.Apart | None, env: str | Factory | None) -> None:
        """Make envs and loop; a resumed run says how it kept its episodes apart `before`."""
        tasks = make_tasks(self.config, before, env)
        self._made_with = {"apart": tasks.apart, **made_with(products.of(self.config.hyper))}
        self.notes += tasks.notes
        kind = OnPolicyLoop if isinstance(self.config.hyper, OnPolicy) else Members
        with closed_by_a_fault(tasks.envs):
            self.loop: Loop = kind(self.config, tasks.envs)
        self._evaluator = Evaluator(self.loop, self.config, self.directory, tasks.recipe)
        self._reporter = Reporter(self.loop, self.config, self.directory, self._evaluator)
        self._stopping = self._closed = False

    def __iter__(self) -> Iterator[Report]:
        """Train until the budget is spent, `stop` is called or the caller breaks; then save."""
        with device_faults():
            yield from self._train()

    def _train(self) -> Iterator[Report]:
        self._refuse_closed()
        self._reporter.start_clock()
        self._saved_at = self.progress.wall_seconds
        try:
            while True:
                self._reporter.tell_time()
                if not self.progress.acting or self.progress.step >= self.budget:
                    # Else a fault of the task broke a tick off, which is to end first.
                    ending = self._spent
                    yield from self._reporter.due(ending)
                    if self._settled and not ending:
                        yield from self._reporter.due(ending=True)
                    if ending or self._stopping or self._settled:
                        break
                    if self._save_is_due():
                        self.save()
                selection = self.loop.tick()
                if selection is not None:
                    self._reporter.add("select", selection.row())
            self.save()
        except GeneratorExit:
            with told("not saved", OSError, TrainingError):  # Python would pass over it
                self.save()
            raise
        except TaskError:
            if self.loop.whole:
                with suppress(TrainingError, OSError):  # the task's error is the one to be seen
                    self.save()
            raise
        except OSError as error:
            where = f"step {self.progress.step}: {self.directory.path}"
            raise TrainingError(f"{where}: {error.strerror or error}") from error
        finally:
            with suppress(TaskError) if sys.exception() else nullcontext():  # the first is seen
                self.close()

    @property
    def progress(self) -> Progress:
        """All counters."""
        return self.loop.progress

    @property
    def budget(self) -> int:
        """Env steps in all, of every member and, where it is counted, of selection."""
        return self.loop.budget

    @property
    def finished(self) -> bool:
        """Whether the budget is spent and the last policy evaluated."""
        return self._spent and self.progress.last_evaluation == self.progress.step

    @property
    def _spent(self) -> bool:
        """Whether the budget of steps, with the updates that are due, or of time is spent."""
        out = out_of_time(vars(self.config.run), self.progress.wall_seconds)
        if out or self._settled:
            return True
        return self.progress.step >= self.budget and not self.loop.has_due_updates

    @property
    def _settled(self) -> bool:
        return is_settled(vars(self.config.run), self.progress.standing)

    def stop(self) -> None:
        """Ask for the end, in a tick or an evaluation at most; a signal handler may call it."""
        self._stopping = True
        self._evaluator.stop()

    def save(self) -> None:
        """Write a checkpoint now."""
        self._refuse_closed()
        self._reporter.tell_time()
        checkpoint.save(self.loop, self.config, self.directory)
        self._saved_at = self.progress.wall_seconds

    def close(self) -> None:
        """Let go of envs, files and the folder."""
        if self._closed:
            return
        self._closed = True
        with ExitStack() as stack:  # which closes the rest too where one fails
            for close in (self.directory.unlock, self._evaluator.close, self.loop.close):
                stack.callback(close)

    def _refuse_closed(self) -> None:
        if self._closed:
            raise UsageError(
                f"run: this trainer has ended; Trainer.resume('{self.directory.path}')"
            )

    def policy(self, member: int | None = None) -> Policy:
        """A member's policy, or what `--eval-policy` names, and where it comes from.

        With `--assess` a member's is the best that was kept (`about["kept_at"]`), else what it is
        now.
        """
        members = self.config.run.members
        if member is not None and not 0 <= member < members:
            raise UsageError(f"member: must be from 0 to {members - 1}, got {member}")
        return self._evaluator.policy(member)

    def ledger(self) -> dict[str, Any]:
        """What the run has spent."""
        return self._reporter.ledger()

    def _save_is_due(self) -> bool:
        waited = self.progress.wall_seconds - self._saved_at
        full = any(replay.must_commit for replay in self.loop.replays)
        return full or waited >= self.config.run.checkpoint_every

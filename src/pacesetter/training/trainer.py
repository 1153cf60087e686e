"""A run from first to last step: an iterator of reports that can stop and go on anywhere."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, Unpack, overload

from pacesetter.config import resolve
from pacesetter.consent import require_all
from pacesetter.ensemble.loop import Loop
from pacesetter.ensemble.members import Members
from pacesetter.ensemble.progress import TRAIN_ROW_EVERY, Clock, Progress
from pacesetter.envs import Environment, apart
from pacesetter.envs.apart import Apart
from pacesetter.envs.tasks import Factory, name_of
from pacesetter.errors import TaskError, TrainingError, UsageError
from pacesetter.learner import products
from pacesetter.learner.backend import made_with, prepare
from pacesetter.policy import Policy
from pacesetter.runs import RunDirectory, find
from pacesetter.seeding import Stream
from pacesetter.settings import OnPolicy
from pacesetter.settings.budget import is_reached, out_of_time
from pacesetter.settings.files import read_file
from pacesetter.training import checkpoint
from pacesetter.training.evaluator import Evaluator, Stopped
from pacesetter.training.on_policy import OnPolicyLoop
from pacesetter.training.report import Report
from pacesetter.training.starting import start_from

if TYPE_CHECKING:
    from pacesetter.settings.typed import Name, RunSettings


class Trainer:
    """A run, new or resumed: iterate over it to train, break to stop; it goes on with `resume`."""

    @overload
    def __init__(
        self,
        algorithm: "Name",
        env: str | Factory,
        *,
        runs: str | Path = "runs",
        config: str | Path | None = None,
        **settings: "Unpack[RunSettings]",
    ) -> None: ...

    @overload  # presets and algorithms of other people
    def __init__(
        self,
        algorithm: str,
        env: str | Factory,
        *,
        runs: str | Path = "runs",
        config: str | Path | None = None,
        **settings: Any,
    ) -> None: ...

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
            require_all("wrap", layers[0].get("wrap", ()))
        self.config = resolve(algorithm, name_of(env), *layers, settings)
        self.directory = RunDirectory.of(runs, self.config)
        self.directory.refuse_existing(self.config)
        self.notes = prepare(self.config.run.device)
        self._begin(None, env)
        if self.config.run.start_from is not None:
            start_from(self.loop, self.config, runs)
        self.directory.create(self.config, **self._made_with())
        try:
            self.loop.open_replays(self.directory.state_file.parent)
            checkpoint.save(self.loop, self.config, self.directory)
        except BaseException:
            self.directory.remove()
            raise
        self.notes += [*self.directory.notes, *products.notes(self.config.hyper)]
        if (full := self.config.run.env) != env and isinstance(env, str):
            self.notes.insert(0, f"env: '{env}' has no version; taking the newest, {full}")

    @classmethod
    def resume(
        cls,
        run: str | Path,
        *,
        runs: str | Path = "runs",
        steps: int | str | None = None,
        time: float | str | None = None,
        stop_at: float | None = None,
        allow: Iterable[str] = (),
        env: Factory | None = None,
    ) -> Self:
        """Take up a run where its last checkpoint left it, with a new budget if one is given.

        `allow` are names in its config that may import a module; `env` is the function that made
        its envs, if one did.
        """
        self = cls.__new__(cls)
        self.directory = find(str(run), runs)
        self.config = self.directory.config(allow)
        budgets = {"steps": steps, "time": time, "stop_at": stop_at}
        changed = {key: value for key, value in budgets.items() if value is not None}
        if changed:
            settings = self.config.settings() | changed
            self.config = resolve(self.config.run.algorithm, self.config.run.env, settings)
        checkpoint.refuse_other_settings(self.config, self.directory)
        self.notes = prepare(self.config.run.device)
        self._begin(apart.recorded(self.directory.record()), env)
        self.directory.lock()
        try:
            self.directory.sweep()
            self.loop.open_replays(self.directory.state_file.parent)
            notes = checkpoint.restore(self.loop, self.config, self.directory)
            self.notes += [*self.directory.notes, *notes]
            if self.progress.step > self.budget:
                made = f"{self.progress.step:,}"
                raise UsageError(f"steps: the run has made {made} already; give more")
            self.directory.note_resume(self.config, self.progress.step, **self._made_with())
        except BaseException:
            self.directory.unlock()
            raise
        return self

    def __repr__(self) -> str:
        run = self.config.run
        done = f"{self.progress.step:,} of {self.budget:,} steps"
        return f"Trainer({run.name} on {run.env}, seed {run.seed}: {done}, {self.directory.path})"

    def _begin(self, before: Apart | None, env: str | Factory | None) -> None:
        """Make envs and loop; a resumed run says how it kept its episodes apart `before`."""
        run, hyper = self.config
        on_policy = isinstance(hyper, OnPolicy)
        recipe = replace(self.config.recipe, factory=env if callable(env) else None)
        self.apart = before or apart.choose(recipe, run.renew_env)
        recipe = replace(recipe, renew=self.apart is Apart.BY_RENEWAL)
        envs = [
            Environment(recipe, run.seed, Stream.TRAIN, index)
            for index in range(hyper.parallel_envs if on_policy else run.members * hyper.num_envs)
        ]
        cast = envs[0].check()
        self.notes += [] if before else cast
        self.notes += apart.notes(self.apart, run.env, resumed=before is not None)
        self.loop: Loop = (OnPolicyLoop if on_policy else Members)(self.config, envs)
        self._evaluator = Evaluator(self.loop, self.config, self.directory, recipe)
        self._reports: list[Report] = []
        self._stopping = self._closed = False
        self._clock = Clock()

    def _made_with(self) -> dict[str, Any]:
        return {"apart": self.apart, **made_with(products.of(self.config.hyper))}

    def __iter__(self) -> Iterator[Report]:
        """Train until the budget is spent, `stop` is called or the caller breaks; then save."""
        self._refuse_closed()
        self._clock = Clock()
        self._saved_at = self.progress.wall_seconds
        try:
            while True:
                self._clock.tell(self.progress)
                ending = self._spent
                self._report_what_is_due(ending)
                reports, self._reports = self._reports, []
                yield from reports
                if ending or self._stopping or self._reached:
                    break
                if self._save_is_due():
                    self.save()
                selection = self.loop.tick()
                if selection is not None:
                    self._emit("select", selection.row())
            self.save()
        except GeneratorExit:
            self.save()
            raise
        except TaskError:
            self._save_if_whole()
            raise
        except OSError as error:
            where = f"step {self.progress.step}: {self.directory.path}"
            raise TrainingError(f"{where}: {error.strerror or error}") from error
        finally:
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
        if out or self._reached:
            return True
        return self.progress.step >= self.budget and not self.loop.has_due_updates

    @property
    def _reached(self) -> bool:
        return is_reached(vars(self.config.run), self.progress.best)

    def stop(self) -> None:
        """Ask for the end after the running tick, or within an evaluation, which a resumed run
        makes again; may be called from a signal handler.
        """
        self._stopping = True
        self._evaluator.stop()

    def save(self) -> None:
        """Write a checkpoint now."""
        self._refuse_closed()
        self._clock.tell(self.progress)
        checkpoint.save(self.loop, self.config, self.directory)
        self._saved_at = self.progress.wall_seconds

    def _save_if_whole(self) -> None:
        """After a fault of the task, whose error is the one to be seen."""
        if self.loop.whole:
            with suppress(TrainingError, OSError):
                self.save()

    def close(self) -> None:
        """Let go of envs, files and the folder."""
        if self._closed:
            return
        self._closed = True
        try:
            self.loop.close()
            self._evaluator.close()
        finally:
            self.directory.unlock()

    def _refuse_closed(self) -> None:
        if self._closed:
            path = self.directory.path
            raise UsageError(f"run: this trainer has ended; Trainer.resume('{path}')")

    def policy(self, member: int | None = None) -> Policy:
        """The policy of the champion, or of a member, as it is now, and where it comes from."""
        return self._evaluator.policy(member)

    def ledger(self) -> dict[str, Any]:
        """What the run has spent."""
        progress = self.progress
        return progress.ledger() | self.loop.learners.ledger(progress.updates, progress.actions)

    # What is due: evaluations, rows of the log, checkpoints.

    def _report_what_is_due(self, ending: bool) -> None:
        progress = self.progress
        pending = ending and bool(progress.ended or progress.losses)
        if progress.step >= progress.next_train or pending:
            progress.next_train = (progress.step // TRAIN_ROW_EVERY + 1) * TRAIN_ROW_EVERY
            self._emit("train", self.loop.training_values())
        last = ending and progress.last_evaluation < progress.step
        # The last one waits for all updates that the budget's last steps made due.
        if (progress.step >= progress.next_evaluation and progress.step < self.budget) or last:
            try:
                values = self._evaluator.evaluate(ending)
            except Stopped:
                return
            self._emit("eval", values)
            every = self.config.run.eval_every * self.config.steps_per_count
            progress.last_evaluation = progress.step
            progress.next_evaluation = (progress.step // every + 1) * every

    def _emit(self, kind: str, values: dict[str, Any]) -> None:
        self._clock.tell(self.progress)
        report = Report(kind, self.progress.step, values, self.ledger())
        self.directory.log.append(report.row())
        self._reports.append(report)

    def _save_is_due(self) -> bool:
        waited = self.progress.wall_seconds - self._saved_at
        full = any(replay.must_commit for replay in self.loop.replays)
        return full or waited >= self.config.run.checkpoint_every

"""Search settings with Optuna: a trial is a run, and a study's file is shared by its workers.

A trial belongs to the process that holds its lock. If a worker dies, the next worker to look
resumes its trial from the checkpoint, so no heartbeat is needed.
"""

import json
import shlex
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pacesetter import algorithms
from pacesetter.config import resolve
from pacesetter.errors import TrainingError, UsageError, tell, writing
from pacesetter.files import make_folder, present, sync_folder, write_atomically
from pacesetter.runs import WITHOUT_RESULT, Row, RunDirectory, find_all
from pacesetter.runs.lock import Lock, alone
from pacesetter.settings import Settings
from pacesetter.study.bench.suite import TUNING_SEEDS
from pacesetter.study.tune.journal import (
    distribution,
    hold,
    is_study,
    open_study,
    optuna,
    ranges,
    refuse_foreign,
    within,
)
from pacesetter.text import printable
from pacesetter.training.trainer import Report, Trainer

RUNNING, COMPLETE = optuna.trial.TrialState.RUNNING, optuna.trial.TrialState.COMPLETE
PRUNED, FAILED = optuna.trial.TrialState.PRUNED, optuna.trial.TrialState.FAIL
OUTCOME = {COMPLETE: "return", PRUNED: "pruned at", FAILED: "failed:"}
FEWEST = 3  # evaluations behind a score, or a tenth of all if that is more

Sink = Callable[[Report], None]
Show = Callable[[Trainer], AbstractContextManager[Sink]]  # opens what shows a trial's reports


class Tuning:
    """One worker on a study of an algorithm on a task, with some settings fixed."""

    def __init__(
        self, algorithm: str, env: str, fixed: Settings, trials: int, file: str | Path
    ) -> None:
        self.algorithm, self.env, self.fixed, self.trials = algorithm, env, fixed, trials
        self.config, self.file = resolve(algorithm, env, fixed), Path(file)
        hyper = algorithms.find(self.config.run.algorithm).Hyper
        self.ranges = within(self.config.budget, ranges(hyper, fixed))
        self.runs = self.file.parent / f"{self.file.name}.runs"
        self._refuse_bad_input()
        # Only .log is no part of the name: sweep.1 and sweep.2 are two studies.
        self.best_file = self.file.with_name(f"{self.file.name.removesuffix('.log')}.best.toml")
        self._lock, journal = Lock(self.runs / "lock"), Lock(self.runs / "journal.lock")
        self._trainer: Trainer | None = None
        self._stopping = False
        settings = {k: v for k, v in self.config.settings().items() if k not in ("name", "seed")}
        run = self.config.run
        with writing("study", self.file):
            for folder in (*reversed(self.runs.parents), self.runs):
                make_folder(folder)
            with alone(self._lock):
                patience = run.steps // run.eval_every // 3
                self.study = open_study(self.file, journal, settings, self.ranges, patience)
            sync_folder(self.file.parent)

    def _refuse_bad_input(self) -> None:
        """Before anything is written."""
        if self.trials < 1:
            raise UsageError(f"trials: must be at least 1, got {self.trials}")
        for key in ("seed", "name"):
            if key in self.fixed:
                raise UsageError(f"{key}: each trial sets its own; seeds start at {TUNING_SEEDS}")
        if _holds_none(self.fixed.get("env_kwargs", {})):
            raise UsageError(
                "env: best.toml cannot hold a keyword of none; leave out --env.KEY none"
            )
        if not self.ranges:
            raise UsageError("tune: no setting is left to search; all are fixed or have no range")
        if not self.file.name or self.file.is_dir():
            raise UsageError(f"study: {self.file} is a folder; name a file, such as tune.log")
        refuse_foreign(self.file)
        stem = self.file.name.removesuffix(".log")
        twin = stem if stem != self.file.name else f"{stem}.log"
        if twin and not self.file.exists() and is_study(self.file.with_name(twin)):
            raise UsageError(f"study: {twin} has the same best.toml; give another --study")
        if not self.file.exists() and any(find_all(self.runs)):
            raise UsageError(
                f"study: {self.file} is gone, but {self.runs} has its trials; move them away, or "
                "give another --study"
            )
        self.config.recipe.make().close()

    def stop(self) -> None:
        """Ask for the end once the running trial has saved; may be called from a handler."""
        self._stopping = True
        if self._trainer is not None:
            self._trainer.stop()

    @property
    def over(self) -> bool:
        """Whether all trials have ended."""
        trials = self.study.get_trials(deepcopy=False)
        return sum(trial.state.is_finished() for trial in trials) >= self.trials

    @property
    def any_complete(self) -> bool:
        """Whether a trial has a score."""
        return any(t.state == COMPLETE for t in self.study.get_trials(deepcopy=False))

    def run(self, show: Show) -> None:
        """Make trials until all have ended or other workers have them; `show` shows each one."""
        while not self._stopping and (claim := self._claim()):
            trial, lock = claim
            try:
                self._try(trial, show)
            finally:
                lock.free()
            jax.clear_caches()  # each trial compiles programs of its own

    def summary(self) -> str:
        """How many trials there were and where the best settings are."""
        states = [trial.state for trial in self.study.get_trials(deepcopy=False)]
        complete, pruned, failed = (states.count(s) for s in (COMPLETE, PRUNED, FAILED))
        text = f"{complete} complete, {pruned} pruned, {failed} failed"
        if not complete:
            return text
        best = self.study.best_trial
        return f"{text}; best {best.value:.1f} in trial {best.number}\nsettings: {self.best_file}"

    def _claim(self) -> tuple[optuna.Trial, Lock] | None:
        """A trial that a dead worker left, or a new one, and its lock; None if there is none."""
        with alone(self._lock):
            for left in self.study.get_trials(deepcopy=False, states=(RUNNING,)):
                if lock := hold(self.runs / f"{left.number}.lock"):
                    # Optuna opens the trial of another process by nothing but this.
                    identity = left._trial_id  # pyright: ignore[reportPrivateUsage]
                    return optuna.Trial(self.study, identity), lock
            begun = [t for t in self.study.get_trials(deepcopy=False) if t.state.name != "WAITING"]
            if len(begun) >= self.trials:
                return None
            # Seeded by the number: one worker makes the same trials, however often it is stopped.
            self.study.sampler = optuna.samplers.TPESampler(seed=len(begun))
            trial = self.study.ask({name: distribution(r) for name, r in self.ranges.items()})
            lock = hold(self.runs / f"{trial.number}.lock")
            assert lock is not None
            return trial, lock

    def _try(self, trial: optuna.Trial, show: Show) -> None:
        """Train one trial until it ends, is pruned or fails; `stop` leaves it open."""
        try:
            self._trainer = trainer = self._trainer_of(trial)
            with show(trainer) as sink:
                pruned = self._train(trial, trainer, sink)
        except (TrainingError, UsageError, MemoryError) as error:
            self._tell(trial, FAILED, None, str(error) or "out of memory")
            self._trainer = None  # with its networks, whose memory the next trial may need
            if not (directory := self._directory_of(trial)).in_use():
                directory.remove_checkpoint()
            return
        if not (pruned or trainer.finished):
            return
        score = _score(trainer.directory.rows())
        self._tell(trial, PRUNED if pruned else COMPLETE, None if pruned else score, f"{score:.1f}")
        trainer.directory.remove_checkpoint()  # replays of all would fill the disk

    def _train(self, trial: optuna.Trial, trainer: Trainer, sink: Sink) -> bool:
        """Whether it was pruned."""
        if self._stopping:
            trainer.stop()
        told = {*self.study.get_trials(deepcopy=False)[trial.number].intermediate_values}
        every = self.config.run.eval_every * self.config.steps_per_count
        for report in trainer:
            sink(report)
            number = report.step // every
            if report.kind != "eval" or number == 0:
                continue
            # A resumed run makes again what it had not saved, and an odd budget ends in a part.
            if number not in told:
                told.add(number)
                trial.report(_score(trainer.directory.rows()), number)
            if trial.should_prune() and not trainer.finished:
                return True
        return False

    def _directory_of(self, trial: optuna.Trial) -> RunDirectory:
        run = replace(self.config.run, **_own(trial))
        return RunDirectory.of(self.runs, self.config._replace(run=run))

    def _trainer_of(self, trial: optuna.Trial) -> Trainer:
        given: Settings = {**self.fixed, **trial.params, **_own(trial)}
        directory = self._directory_of(trial)
        if not present(directory.config_file):
            return Trainer(self.algorithm, self.env, runs=self.runs, **given)
        try:
            allow = [self.algorithm, self.env, *self.config.run.wrap]
            now = {key: given[key] for key in WITHOUT_RESULT & given.keys()}
            trainer = Trainer.resume(directory.path, runs=self.runs, allow=allow, **now)
        except UsageError as error:  # damaged, which is no reason to stop the study
            raise TrainingError(str(error)) from None
        for note in trainer.notes:
            tell(note)
        return trainer

    def _tell(self, trial: optuna.Trial, state: Any, value: float | None, text: str) -> None:
        with alone(self._lock):
            self.study.tell(trial, value, state)
            if self.any_complete:
                best = self.study.best_trial
                text = f"{text}, best {best.value:.1f} in trial {best.number}"
                write_atomically(self.best_file, self._best_toml(best).encode())
        print(
            f"trial {trial.number} of {self.trials}: {OUTCOME[state]} {text}",
            file=sys.stderr,
            flush=True,
        )

    def _best_toml(self, best: optuna.trial.FrozenTrial) -> str:
        run = self.config.run
        words = ["train", self.algorithm, run.env, "--config", str(self.best_file)]
        words += ["--wrap", *run.wrap] if run.wrap else []  # which a file alone may not name
        given = {k: self.config.settings()[k] for k in self.fixed if k not in ("steps", "time")}
        lines = [
            f"# pacesetter {printable(shlex.join(words))}",
            f"# Return {best.value:.1f} at {run.steps:,} steps in trial {best.number}, with seed "
            f"{TUNING_SEEDS + best.number}: the best of",
            "# many, so biased upwards; only runs with other seeds tell what these settings give.",
            *(f"{key} = {_toml(value)}" for key, value in (given | best.params).items()),
        ]
        return "\n".join(lines) + "\n"


def _own(trial: optuna.Trial) -> Settings:
    """The settings that only this trial has, beside those that are searched."""
    return {"name": f"trial-{trial.number}", "seed": TUNING_SEEDS + trial.number}


def _score(rows: list[Row]) -> float:
    """Mean return of the last evaluations, a tenth of all or FEWEST, after the first update.

    Before that a policy says nothing of its settings; without any, all but step 0 count.
    """
    found = [row for row in rows if row["kind"] == "eval" and row["step"] > 0]
    means = [row["mean"] for row in found if row["updates"] > 0] or [row["mean"] for row in found]
    return float(np.mean(means[-max(FEWEST, len(means) // 10) :]))


def _holds_none(value: Any) -> bool:
    """Whether a value, or one inside it, is None, for which TOML has no word."""
    if isinstance(value, dict):
        return any(map(_holds_none, value.values()))
    return value is None or (isinstance(value, (list, tuple)) and any(map(_holds_none, value)))


def _toml(value: Any) -> str:
    """A value as TOML, which reads JSON's words, but no Infinity and no emoji in two halves."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)

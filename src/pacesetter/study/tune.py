"""Search settings with Optuna: a trial is a run, a study a journal file that workers share.

A trial belongs to the process that holds its lock file. One whose worker died is taken up by
whoever looks next and goes on from its checkpoint, so that no heartbeat is needed.
"""

import fcntl
import json
import shutil
import sys
from collections.abc import Generator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pacesetter import algorithms
from pacesetter.config import Settings, Tune, settle
from pacesetter.envs import make
from pacesetter.errors import TrainingError, UsageError
from pacesetter.runs import Row, RunDirectory
from pacesetter.sinks import Sink, console
from pacesetter.storage import write_atomically
from pacesetter.study.suite import TUNING_SEEDS
from pacesetter.training.trainer import Trainer

try:
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalStorage
except ImportError:
    raise UsageError("tune: Optuna is not installed; pip install 'pacesetter[tune]'") from None

RUNNING, COMPLETE = optuna.trial.TrialState.RUNNING, optuna.trial.TrialState.COMPLETE
PRUNED, FAILED = optuna.trial.TrialState.PRUNED, optuna.trial.TrialState.FAIL
LAST = 3  # evaluations that a score is the mean of, or a tenth of all


class Tuning:
    """One worker on a study of an algorithm on a task, with some settings fixed."""

    def __init__(
        self, algorithm: str, env: str, fixed: Settings, trials: int, file: str | Path
    ) -> None:
        if trials < 1:
            raise UsageError(f"trials: must be at least 1, got {trials}")
        for key in ("seed", "name"):
            if key in fixed:
                raise UsageError(
                    f"{key}: trials have names and seeds (from {TUNING_SEEDS}) of their own"
                )
        self.algorithm, self.env, self.fixed, self.trials = algorithm, env, fixed, trials
        self.config = settle(algorithm, env, fixed)
        self.ranges = ranges(algorithms.find(self.config.run.algorithm).Hyper, fixed)
        if not self.ranges:
            raise UsageError("tune: no setting is left to search; each is given or has no range")
        make(env, self.config.run.env_kwargs).close()
        self.file = Path(file)
        self.best_file = self.file.with_suffix(".best.toml")
        self.runs = self.file.with_name(f"{self.file.name}.runs")
        self._trainer: Trainer | None = None
        self._stopping = False
        self.study = self._open()

    def stop(self) -> None:
        """Ask for the end once the running trial has saved; may be called from a handler."""
        self._stopping = True
        if self._trainer is not None:
            self._trainer.stop()

    @property
    def over(self) -> bool:
        """Whether all trials have been made."""
        trials = self.study.get_trials(deepcopy=False)
        return len([t for t in trials if t.state.is_finished()]) >= self.trials

    def run(self, quiet: bool = False) -> None:
        """Make trials until all are made or being made by other workers."""
        while not self._stopping and (claim := self._claim()):
            trial, lock = claim
            with lock:
                self._try(trial, quiet)
            jax.clear_caches()  # each trial compiles programs of its own

    def summary(self) -> str:
        """How many trials there were and where the best settings are."""
        trials = self.study.get_trials(deepcopy=False)
        states = {s: len([t for t in trials if t.state == s]) for s in (COMPLETE, PRUNED, FAILED)}
        text = f"{states[COMPLETE]} trials, {states[PRUNED]} pruned, {states[FAILED]} failed"
        if not states[COMPLETE]:
            return text
        best = self.study.best_trial
        return f"{text}; best {best.value:.1f} in trial {best.number}\nsettings: {self.best_file}"

    # One trial.

    def _claim(self) -> tuple[optuna.Trial, TextIOWrapper] | None:
        """A trial that a dead worker left, or a new one, and its lock; None if there is none."""
        with self._locked():
            for left in self.study.get_trials(deepcopy=False, states=(RUNNING,)):
                if lock := _hold(self.runs / f"{left.number}.lock"):
                    identity = left._trial_id  # pyright: ignore[reportPrivateUsage]
                    return optuna.Trial(self.study, identity), lock
            begun = [t for t in self.study.get_trials(deepcopy=False) if t.state.name != "WAITING"]
            if len(begun) >= self.trials:
                return None
            # Seeded by the number, one worker makes the same trials whenever it is stopped.
            self.study.sampler = optuna.samplers.TPESampler(seed=len(begun))
            trial = self.study.ask(self.ranges)
            lock = _hold(self.runs / f"{trial.number}.lock")
            assert lock is not None
            return trial, lock

    def _try(self, trial: optuna.Trial, quiet: bool) -> None:
        """Train one to its end, its pruning, a fault, or `stop`, after which it stays open."""
        try:
            self._trainer = trainer = self._trainer_of(trial)
            with console(trainer, quiet) as sink:
                pruned = self._train(trial, trainer, sink)
        except TrainingError as error:
            self._tell(trial, FAILED, None, str(error))
            return
        if not (pruned or trainer.finished):
            return
        score = _score(trainer.directory.rows())
        self._tell(trial, PRUNED if pruned else COMPLETE, None if pruned else score, f"{score:.1f}")
        shutil.rmtree(trainer.directory.state_file.parent)  # replays of all would fill the disk

    def _train(self, trial: optuna.Trial, trainer: Trainer, sink: Sink) -> bool:
        """Whether it was pruned."""
        if self._stopping:
            trainer.stop()
        told = self.study.get_trials(deepcopy=False)[trial.number].intermediate_values
        every = self.config.run.eval_every * self.config.unit
        for report in trainer:
            sink(report)
            number = report.step // every
            if report.kind != "eval" or number == 0:
                continue
            if number not in told:  # else the log was cut back and these are made again
                trial.report(_score(trainer.directory.rows()), number)
            if trial.should_prune() and not trainer.finished:
                return True
        return False

    def _trainer_of(self, trial: optuna.Trial) -> Trainer:
        number = trial.number
        given: Settings = {**self.fixed, **trial.params}
        own: Settings = {"name": f"trial-{number}", "seed": TUNING_SEEDS + number}
        config = settle(self.algorithm, self.env, given, own)
        directory = RunDirectory.of(self.runs, config)
        if not directory.config_file.exists():
            return Trainer(self.algorithm, self.env, runs=self.runs, **(given | own))
        try:
            trainer = Trainer.resume(directory.path)
        except UsageError as error:  # damaged: no reason to stop the study
            raise TrainingError(str(error)) from None
        for note in trainer.notes:
            print(f"pacesetter: {note}", file=sys.stderr)
        return trainer

    def _tell(self, trial: optuna.Trial, state: Any, value: float | None, text: str) -> None:
        with self._locked():
            self.study.tell(trial, value, state)
            if any(t.state == COMPLETE for t in self.study.get_trials(deepcopy=False)):
                best = self.study.best_trial
                text = f"{text}, best {best.value:.1f} in trial {best.number}"
                write_atomically(self.best_file, self._best_toml(best).encode())
        word = {COMPLETE: "return", PRUNED: "pruned at", FAILED: "failed:"}[state]
        print(f"trial {trial.number} of {self.trials}: {word} {text}", file=sys.stderr, flush=True)

    # The study's files.

    def _open(self) -> optuna.Study:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._refuse_foreign()
        evaluations = self.config.run.steps // self.config.run.eval_every
        try:
            self.runs.mkdir(parents=True, exist_ok=True)
            with self._locked():
                study = optuna.create_study(
                    storage=JournalStorage(JournalFileBackend(str(self.file))),
                    study_name="pacesetter",
                    direction="maximize",
                    pruner=optuna.pruners.MedianPruner(n_warmup_steps=evaluations // 3),
                    load_if_exists=True,
                )
                self._refuse_other(study)
        except OSError as error:
            raise UsageError(f"study: cannot write {self.file}: {error.strerror}") from None
        return study

    def _refuse_foreign(self) -> None:
        """Refuse a file that is no journal, onto which Optuna would write all the same."""
        try:
            with self.file.open() as file:
                line = file.readline()
            if line and "op_code" not in json.loads(line):
                raise ValueError("no journal of Optuna")
        except FileNotFoundError:
            pass
        except (OSError, ValueError, TypeError) as error:
            raise UsageError(f"study: {self.file} is no study: {error}") from None

    def _refuse_other(self, study: optuna.Study) -> None:
        """Refuse a study of other settings; a new one begins with the defaults."""
        settings = {k: v for k, v in self.config.settings().items() if k not in ("name", "seed")}
        searched = {f"range of {name}": repr(range_) for name, range_ in self.ranges.items()}
        new: Settings = json.loads(json.dumps(settings | searched))
        old = study.user_attrs.get("about")
        if old is None:
            study.set_user_attr("about", new)
            usual = {name: settings[name] for name in self.ranges}
            inside = {k: v for k, v in usual.items() if self.ranges[k]._contains(v)}
            study.enqueue_trial(inside)
            return
        for key in {**old, **new}:
            if old.get(key) != new.get(key):
                raise UsageError(
                    f"study: {self.file} has {key}={old.get(key)}, not {new.get(key)}; "
                    "give another --study"
                )

    def _best_toml(self, best: optuna.trial.FrozenTrial) -> str:
        run = self.config.run
        given = {k: self.config.settings()[k] for k in self.fixed if k not in ("steps", "time")}
        return "\n".join(
            [
                f"# pacesetter train {self.algorithm} {run.env} --config {self.best_file}",
                f"# Return {best.value:.1f} at {run.steps:,} steps, in trial {best.number} with "
                f"seed {TUNING_SEEDS + best.number}: the best",
                "# of many trials, so biased upwards; only runs with other seeds tell what it is.",
                *(f"{key} = {_toml(value)}" for key, value in (given | best.params).items()),
                "",
            ]
        )

    @contextmanager
    def _locked(self) -> Generator[None]:
        """One worker at a time claims or tells."""
        with (self.runs / "lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def ranges(hyper: type, fixed: Settings) -> dict[str, Any]:
    """What Optuna searches: the settings that declare a range and are not fixed."""
    found: dict[str, Any] = {}
    for name, info in vars(hyper)["__pydantic_fields__"].items():
        for mark in info.metadata:
            if isinstance(mark, Tune) and name not in fixed:
                found[name] = _distribution(*mark)
    return found


def _distribution(low: Any, high: Any, log: bool) -> Any:
    if isinstance(low, bool):
        return optuna.distributions.CategoricalDistribution([low, high])
    if isinstance(low, int):
        return optuna.distributions.IntDistribution(low, high, log)
    return optuna.distributions.FloatDistribution(low, high, log)


def _hold(path: Path) -> TextIOWrapper | None:
    """A file locked until it is closed or the process ends; None if another process holds it."""
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file


def _score(rows: list[Row]) -> float:
    """Mean return of the last evaluations, a tenth of them or LAST; that of step 0 never counts."""
    means = [row["mean"] for row in rows if row["kind"] == "eval" and row["step"] > 0]
    return float(np.mean(means[-max(LAST, len(means) // 10) :]))


def _toml(value: Any) -> str:
    """A value as TOML, which reads JSON's numbers, words and lists."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    return json.dumps(value)

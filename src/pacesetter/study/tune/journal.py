"""Files of a study: Optuna's journal, the ranges it searches, and locks that end with a process."""

import json
from math import isfinite
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.runs import OLDER, WITHOUT_RESULT
from pacesetter.runs.lock import Lock, alone, wait_for
from pacesetter.settings import Settings
from pacesetter.settings.validation import difference, fields_of
from pacesetter.settings.values import Tune
from pacesetter.storage import FAULTS

try:
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalStorage
    from optuna.storages.journal._file import BaseJournalFileLock
except ImportError:
    raise UsageError("tune: Optuna is not installed; pip install 'pacesetter[tune]'") from None

Ranges = dict[str, Tune]
RANGE = "range of "  # before the name of a setting that a study searches


def ranges(hyper: type, fixed: Settings) -> Ranges:
    """The settings to search: those that declare a range and are not fixed."""
    return {
        name: mark
        for name, info in fields_of(hyper).items()
        for mark in info.metadata
        if isinstance(mark, Tune) and name not in fixed
    }


def within(budget: int, searched: Ranges) -> Ranges:
    """The ranges with a warm-up of at most half the budget, as a trial that never learns says
    nothing; without it where even the shortest is longer.
    """
    if "warmup" not in searched:
        return searched
    low, high, log = searched["warmup"]
    most = min(int(high), budget // 2)
    left = {name: mark for name, mark in searched.items() if name != "warmup"}
    return searched | {"warmup": Tune(low, most, log)} if most > low else left


def distribution(range_: Tune) -> Any:
    """A range as Optuna's distribution."""
    low, high, log = range_
    if isinstance(low, bool):
        return optuna.distributions.CategoricalDistribution([low, high])
    if isinstance(low, int):
        return optuna.distributions.IntDistribution(low, int(high), log)
    return optuna.distributions.FloatDistribution(low, high, log)


def open_study(
    file: Path, lock: Lock, settings: Settings, searched: Ranges, patience: int
) -> optuna.Study:
    """Open a study, or make one whose first trial has the default settings.

    A trial is pruned if it is below the median after `patience` reports. Raises UsageError if the
    file holds a study with other settings.
    """
    study = _read(file, lock, patience)
    about = settings | {f"{RANGE}{name}": mark for name, mark in searched.items()}
    new: Settings = json.loads(json.dumps(about))
    old = study.user_attrs.get("about")
    if old is None:
        study.set_user_attr("about", new)
        usual = {name: settings[name] for name in searched}
        study.enqueue_trial({k: v for k, v in usual.items() if searched[k].has(v)})
        return study
    # What changes no score is no difference, nor is a setting that another version did not have.
    old = OLDER | old
    shared = [key for key in settings if key in old and key not in WITHOUT_RESULT]
    if found := difference(
        old, new, [*shared, *(k for k in {**old, **new} if k.startswith(RANGE))]
    ):
        raise UsageError(f"study: {file} has {found}; give another --study")
    return study


def _read(file: Path, lock: Lock, patience: int) -> optuna.Study:
    """The study of a journal, all of which Optuna reads here and takes as it comes."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    _mend(file, lock)
    try:
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(file), _JournalLock(lock))),
            study_name="pacesetter",
            direction="maximize",
            pruner=optuna.pruners.MedianPruner(n_warmup_steps=patience),
            load_if_exists=True,
        )
        _refuse_odd(study)
    except (*FAULTS, AssertionError, RuntimeError) as error:
        why = f"{type(error).__name__}: {error}"
        raise UsageError(f"study: {file} is damaged: {why}; give another --study") from None
    return study


def _refuse_odd(study: optuna.Study) -> None:
    """A ValueError for what no worker of ours has written."""
    if study.direction != optuna.study.StudyDirection.MAXIMIZE:
        raise ValueError("it does not maximize")
    if not isinstance(study.user_attrs.get("about", {}), dict):
        raise ValueError("its settings are no table")
    for trial in study.get_trials(deepcopy=False):
        complete = trial.state == optuna.trial.TrialState.COMPLETE
        scores = [*trial.intermediate_values.values(), *([trial.value] if complete else [])]
        numbers = [*trial.params.values(), *scores]
        if not all(isinstance(number, (int, float)) and isfinite(number) for number in numbers):
            raise ValueError(f"trial {trial.number} has odd numbers: {numbers}")


def refuse_foreign(file: Path) -> None:
    """Refuse a file that is not a journal, to which Optuna would write all the same."""
    try:
        if file.exists() and not file.is_file():
            raise ValueError("not a file")
        with file.open(encoding="utf-8") as lines:
            line = lines.readline()
        if line and "op_code" not in json.loads(line):
            raise ValueError("not a journal of Optuna")
    except FileNotFoundError:
        pass
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise UsageError(f"study: {file} is not a study: {error}") from None


def is_study(file: Path) -> bool:
    """Whether a file is there that a study has begun."""
    try:
        refuse_foreign(file)
        return file.stat().st_size > 0
    except (UsageError, OSError):
        return False


def hold(path: Path) -> Lock | None:
    """A lock that is held now; None if another has it or may have it."""
    lock = Lock(path)
    try:
        lock.take()
    except UsageError:
        return None
    return lock


class _JournalLock(BaseJournalFileLock):
    """Optuna's own locks are files that outlive a killed process, and then nobody gets them."""

    def __init__(self, lock: Lock) -> None:
        self._lock = lock

    def acquire(self) -> bool:
        wait_for(self._lock)
        return True

    def release(self) -> None:
        self._lock.free()


def _mend(file: Path, lock: Lock) -> None:
    """Cut off the line that a killed process has not finished; Optuna would stumble over it."""
    with alone(lock), file.open("a+b") as journal:
        journal.seek(0)
        journal.truncate(journal.read().rfind(b"\n") + 1)

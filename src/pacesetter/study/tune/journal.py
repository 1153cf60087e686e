"""A study's files: Optuna's journal, what it searches, and locks that end with their holder."""

import fcntl
import json
from collections.abc import Generator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.settings import Settings, Tune
from pacesetter.validation import difference, fields_of

try:
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalStorage
except ImportError:
    raise UsageError("tune: Optuna is not installed; pip install 'pacesetter[tune]'") from None

Ranges = dict[str, Tune]


def ranges(hyper: type, fixed: Settings) -> Ranges:
    """What is searched: the settings that declare a range and are not fixed."""
    return {
        name: mark
        for name, info in fields_of(hyper).items()
        for mark in info.metadata
        if isinstance(mark, Tune) and name not in fixed
    }


def distribution(range_: Tune) -> Any:
    """A range as Optuna has it."""
    low, high, log = range_
    if isinstance(low, bool):
        return optuna.distributions.CategoricalDistribution([low, high])
    if isinstance(low, int):
        return optuna.distributions.IntDistribution(low, int(high), log)
    return optuna.distributions.FloatDistribution(low, high, log)


def open_study(file: Path, settings: Settings, searched: Ranges, patience: int) -> optuna.Study:
    """A new study, which begins with the settings as they are, or one of the same that is there.

    A trial is given up if it is behind the median after `patience` reports.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(file))),
        study_name="pacesetter",
        direction="maximize",
        pruner=optuna.pruners.MedianPruner(n_warmup_steps=patience),
        load_if_exists=True,
    )
    about = settings | {f"range of {name}": mark for name, mark in searched.items()}
    new: Settings = json.loads(json.dumps(about))
    old = study.user_attrs.get("about")
    if old is None:
        study.set_user_attr("about", new)
        usual = {name: settings[name] for name in searched}
        study.enqueue_trial({k: v for k, v in usual.items() if searched[k].has(v)})
        return study
    if found := difference(old, new, {**old, **new}):
        raise UsageError(f"study: {file} has {found}; give another --study")
    return study


def refuse_foreign(file: Path) -> None:
    """Refuse a file that is no journal, onto which Optuna would write all the same."""
    try:
        with file.open() as lines:
            line = lines.readline()
        if line and "op_code" not in json.loads(line):
            raise ValueError("no journal of Optuna")
    except FileNotFoundError:
        pass
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"study: {file} is no study: {error}") from None


def hold(path: Path) -> TextIOWrapper | None:
    """A file locked until it is closed or the process ends; None if another has it."""
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file


@contextmanager
def alone(path: Path) -> Generator[None]:
    """One process at a time is in here."""
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield

"""A whole run to a file and back, bit for bit; each part of the loop saves and restores itself."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pacesetter import files, storage
from pacesetter.config import Config
from pacesetter.ensemble.loop import Loop
from pacesetter.errors import TrainingError, UsageError
from pacesetter.learner import products
from pacesetter.learner.learners import Learners
from pacesetter.learner.tree_arrays import below
from pacesetter.process import threads
from pacesetter.replay.buffer import Replay
from pacesetter.runs import RunDirectory
from pacesetter.settings.validation import Natural, check
from pacesetter.storage import Content
from pacesetter.training.identity import (
    KIND,
    SCHEMA,
    Refused,
    fixed,
    identity,
    refuse_strangers,
)
from pacesetter.types import Arrays

LATER = ("averages",)  # parts that the first checkpoints of this schema have not


@dataclass
class _Header:
    """What a checkpoint says of itself, beside its parts."""

    log: Natural  # bytes of the log
    threads: Natural
    products: str = "xla"
    log_hash: str | None = None  # old ones have none


def save(loop: Loop, config: Config, directory: RunDirectory) -> None:
    """Write the checkpoint; the one before it stays as previous.safetensors."""
    arrays: Arrays = {}
    loop.learners.refuse_faults(range(config.run.members), loop.progress.step)
    for name, part in loop.parts().items():
        found = {f"{name}.{key}": array for key, array in part.arrays().items()}
        # Scores of a replay are NaN until an episode ends; learners are checked above.
        if not isinstance(part, (Replay, Learners)):
            _refuse_faults(found, loop.progress.step)
        arrays |= found
    size, log_hash = directory.log.seal()
    table = {
        "schema": SCHEMA,
        "threads": threads(),
        "products": products.of(config.hyper),
        "run": identity(config),
        **{name: part.table() for name, part in loop.parts().items()},
        "settings": fixed(config),
        "log": size,
        "log_hash": log_hash,
    }
    storage.write(directory.state_file, KIND, Content(arrays, table), directory.previous_file)


def restore(loop: Loop, config: Config, directory: RunDirectory) -> list[str]:
    """Take up the newest checkpoint that is whole; what a person should know about it, in lines."""
    notes: list[str] = []
    for file in filter(files.present, directory.checkpoints):
        try:
            _restore(loop, config, directory, file, notes)
        except Refused:
            raise
        except UsageError as error:
            notes.append(f"{error}; trying the checkpoint before it")
            continue
        notes += directory.set_aside()
        if file != directory.state_file:  # the next save must not keep the damaged one instead
            files.link(file, directory.state_file)
        return notes
    if not notes and directory.log.read():
        notes = [f"{directory.state_file}: is missing"]
    if notes:
        first = notes[0].removesuffix("; trying the checkpoint before it")
        raise UsageError(
            f"{first}; no whole checkpoint is left in {directory.path}; "
            "train it again under another --name"
        )
    return ["no checkpoint yet, starting from the beginning"]


def _restore(
    loop: Loop, config: Config, directory: RunDirectory, file: Path, notes: list[str]
) -> None:
    arrays, table = storage.read(file, KIND)
    refuse_strangers(file, table, config)
    try:
        check(_Header, table)
        size: int = table["log"]
        _refuse_other_log(directory, size, table.get("log_hash"))
        for name, part in loop.parts().items():
            if name in LATER and name not in table:
                notes.append(f"{name}: the checkpoint has none yet; they begin now")
                continue
            if note := part.restore(table[name], below(name, arrays)):
                notes.append(f"{name.replace('.', ' ')}: {note}")
    except storage.FAULTS as error:
        raise UsageError(f"{file}: does not fit this run: {error}") from None
    if not directory.log.cut(size):
        notes.append(f"{directory.metrics_file}: rows of the log are missing")
    if table["threads"] != threads() and loop.progress.step < loop.budget:
        notes.append(
            f"made with {table['threads']} threads, going on with {threads()}: "
            "results will differ in their last bits; "
            f"in Python, NPROC={table['threads']} keeps them equal"
        )
    made_by, now_by = table.get("products", "xla"), products.of(config.hyper)
    if made_by != now_by and loop.progress.step < loop.budget:
        notes.append(
            f"made with products by {made_by}, going on with {now_by}: "
            "results will differ in their last bits"
        )


def _refuse_other_log(directory: RunDirectory, size: int, log_hash: str | None) -> None:
    try:
        directory.log.refuse_other(size, log_hash)
    except UsageError as error:
        raise Refused(str(error)) from None


def _refuse_faults(arrays: Arrays, step: int) -> None:
    """Stop a run whose arrays are not all finite."""
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise TrainingError(f"step {step}: {name} is not finite")

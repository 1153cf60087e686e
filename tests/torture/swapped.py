"""Experiment: every file of a run cut, flipped, emptied, swapped, or no file at all any more."""

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from attempts import Tally, attempt, command, patched
from short_runs import TINY, run_to_end

from pacesetter import storage
from pacesetter.runs import RunDirectory
from pacesetter.training.trainer import Trainer

VERBS = ("resume", "show", "eval", "compare", "list")


def _flip(file: Path, rng: random.Random) -> None:
    data = bytearray(file.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    file.write_bytes(data)


def _replace(make: Callable[[Path], Any]) -> Callable[[Path, random.Random], None]:
    def change(file: Path, rng: random.Random) -> None:
        file.unlink()
        make(file)

    return change


def _cut(file: Path, rng: random.Random) -> None:
    os.truncate(file, rng.randrange(file.stat().st_size))


def _swap(file: Path, rng: random.Random) -> None:
    other = rng.choice([each for each in file.parent.iterdir() if each.is_file() and each != file])
    file.write_bytes(other.read_bytes())


WAYS: dict[str, Callable[[Path, random.Random], None]] = {
    "cut": _cut,
    "flipped": _flip,
    "emptied": lambda file, rng: os.truncate(file, 0),
    "swapped": _swap,
    "a folder": _replace(Path.mkdir),
    "a link": _replace(lambda file: file.symlink_to("/dev/zero")),
    "a FIFO": _replace(os.mkfifo),
}


def run(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many runs with one file changed; what is taken up must be a whole checkpoint's state."""
    rng = random.Random(seed)
    settings: dict[str, Any] = TINY | {"steps": 260, "hidden": (4,), "eval_every": 100}
    base = run_to_end(Trainer("td3", "Pendulum-v1", runs=folder / "made", **settings))
    whole = {
        storage.read(file, "checkpoint").table["progress"]["tick"]
        for file in (base.state_file, base.previous_file)
    }
    files = [path for path in base.path.rglob("*") if path.is_file() and path.stat().st_size]
    tally = Tally()
    for number in range(count):
        way, file, verb = rng.choice([*WAYS]), rng.choice(files), VERBS[number % len(VERBS)]
        copy = RunDirectory(Path(shutil.copytree(base.path, folder / "runs" / str(number))))
        WAYS[way](copy.path / file.relative_to(base.path), rng)
        about = f"{file.name} {way}, {verb}"
        if verb == "resume":
            attempt(tally, about, lambda copy=copy: _take_up(copy, whole))
        else:
            more = {
                "list": ["runs", "--runs", copy.path.parent],
                "eval": [copy.path, "--episodes", 1],
            }
            with patched(Trainer, "__iter__", lambda self: iter(())):
                attempt(tally, about, command(verb, *more.get(verb, [copy.path])))
        shutil.rmtree(copy.path)
    return tally


def _take_up(copy: RunDirectory, whole: set[int]) -> None:
    trainer = Trainer.resume(copy.path)
    try:
        assert trainer.progress.tick in whole, "a state was taken up that nobody saved"
    finally:
        trainer.close()

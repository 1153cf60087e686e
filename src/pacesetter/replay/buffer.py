"""The replay: one ring of packed float32 rows in a memory-mapped file.

The file holds a little more than the logical window (SLACK), so rows written after a checkpoint
never overwrite what that checkpoint, or the one before it, still needs.
"""

import mmap
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pacesetter.batch import Layout, Transition
from pacesetter.errors import UsageError
from pacesetter.files import make_folder, regular, reserve
from pacesetter.replay.by_return import ByReturn
from pacesetter.replay.prioritized import MEASURES, ByError
from pacesetter.replay.sampler import Sampler
from pacesetter.settings import MAX_ROWS_PER_TICK
from pacesetter.storage import digest
from pacesetter.types import Arrays, Floats, Numbers

BLOCK = 4096  # rows hashed together
UNCOMMITTED = 32_768  # rows that may be added between two checkpoints
SLACK = 2 * (UNCOMMITTED + MAX_ROWS_PER_TICK) + BLOCK


class Sample(NamedTuple):
    """Sampled rows (..., width), their numbers and their importance (None: all 1)."""

    rows: Floats
    numbers: Numbers
    weight: Floats | None


class Replay:
    """A ring of the last `capacity` transitions; row n of the run lies in slot n % slots."""

    def __init__(
        self,
        path: Path,
        layout: Layout,
        capacity: int,
        budget: int,
        sampler: Sampler | None = None,
        rows_per_tick: int | None = None,
    ) -> None:
        """`budget` is how many rows the whole run adds at most, `rows_per_tick` one tick."""
        self.rows_per_tick = MAX_ROWS_PER_TICK if rows_per_tick is None else rows_per_tick
        self.path, self.layout, self.capacity = path, layout, capacity
        self.sampler = sampler or Sampler()
        self.slots = capacity + SLACK
        self.head = 0  # rows added so far
        self.committed = 0  # rows that the latest checkpoint covers
        self.hashes: list[str] = []  # of each complete block since the first row
        self._map = _map_file(path, min(self.slots, budget) * layout.width * 4)
        count = len(self._map) // (4 * layout.width)
        flat = np.frombuffer(self._map, np.float32, count * layout.width)
        self.rows: Floats = flat.reshape(count, layout.width)

    def __len__(self) -> int:
        return min(self.head, self.capacity)

    @property
    def window(self) -> range:
        """The numbers of the rows that can be sampled."""
        return range(self.head - len(self), self.head)

    @property
    def must_commit(self) -> bool:
        """Whether more rows would eat into what the checkpoint before the latest needs."""
        return self.head - self.committed + self.rows_per_tick >= UNCOMMITTED + MAX_ROWS_PER_TICK

    def add(self, transition: Transition, env: int = 0) -> None:
        """Store one transition of env `env`."""
        self.append(self.layout.pack(transition), transition.earned or 0.0, env)

    def append(self, row: Floats, earned: float = 0.0, env: int = 0) -> None:
        """Store one transition that is packed already."""
        self.rows[self.head % self.slots] = row
        self.sampler.add(self.head, env, earned)
        self.head += 1

    def padded(self, size: int) -> Floats:
        """The window as rows (size, width): row n of the run at n % size, zeros where none is."""
        rows = np.zeros((size, self.layout.width), np.float32)
        numbers = np.array(self.window[-size:])
        rows[numbers % size] = self.rows[numbers % self.slots]
        return rows

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...], done: float = 0.0) -> Sample:
        """Rows sampled from the window; `done` is the share of the horizon that has passed."""
        numbers, weight = self.sampler.sample(rng, shape, self.window, done)
        return Sample(self.rows.take(numbers % self.slots, axis=0), numbers, weight)

    def feedback(self, numbers: Numbers, td_error: Floats) -> None:
        """The TD errors that an update found in sampled rows, before any further row is added."""
        self.sampler.feedback(numbers, td_error)

    def arrays(self) -> Arrays:
        """What a checkpoint must hold besides the rows."""
        return self.sampler.arrays(self.window)

    def commit(self) -> dict[str, Any]:
        """Put all rows on disk; what a checkpoint must know to find and verify them again."""
        page = mmap.ALLOCATIONGRANULARITY
        for start, stop in self._spans(self.committed, self.head):
            first, end = (row * self.layout.width * 4 for row in (start, stop))
            first -= first % page
            self._map.flush(first, min(end - first, len(self._map) - first))
        for block in range(len(self.hashes), self.head // BLOCK):
            self.hashes.append(self._hash(block * BLOCK, (block + 1) * BLOCK))
        self.committed = self.head
        tail = self._hash(self.head // BLOCK * BLOCK, self.head)
        first = self._first_block()
        return {"head": self.head, "blocks": [first, *self.hashes[first:]], "tail": tail}

    table = commit  # as the part of a checkpoint that it is

    def restore(self, table: dict[str, Any], arrays: Arrays | None = None) -> None:
        """Take up the ring where a checkpoint left it, or refuse rows that are not its own."""
        self.head = self.committed = int(table["head"])
        first, *hashes = table["blocks"]
        self.hashes = [""] * first + hashes
        for block in range(self._first_block(), len(self.hashes)):
            if self._hash(block * BLOCK, (block + 1) * BLOCK) != self.hashes[block]:
                raise UsageError(f"{self.path}: damaged: rows from {block * BLOCK} on differ")
        if self._hash(self.head // BLOCK * BLOCK, self.head) != table["tail"]:
            raise UsageError(f"{self.path}: damaged: its newest rows differ")
        self.sampler.restore(arrays or {}, self.window)

    def close(self) -> None:
        """Let go of the file, which is unmapped with its last user."""
        del self.rows, self._map

    def _first_block(self) -> int:
        return self.window.start // BLOCK

    def _spans(self, start: int, stop: int) -> list[tuple[int, int]]:
        """The slots of rows start..stop, in one span or, around the end of the file, two."""
        if start == stop:
            return []
        first, last = start % self.slots, (stop - 1) % self.slots + 1
        return [(first, last)] if first < last else [(first, self.slots), (0, last)]

    def _hash(self, start: int, stop: int) -> str:
        spans = self._spans(start, stop)
        return digest(np.concatenate([self.rows[a:b] for a, b in spans])) if spans else ""


def make_sampler(hyper: Any, size: int) -> Sampler:
    """The sampler that settings ask for, of a replay with at most `size` rows."""
    exponent, importance = hyper.exponents
    if hyper.replay == "uniform":
        return Sampler()
    if hyper.replay == "return":
        return ByReturn(size, exponent, importance, hyper.replay_to_go)
    return ByError(size, exponent, importance, MEASURES[hyper.replay])


def open_replays(folder: Path, count: int, layout: Layout, hyper: Any, budget: int) -> list[Replay]:
    """Make or find rings, each in a file of its own, which takes its whole space at once."""
    size = hyper.replay_size
    return [
        Replay(
            folder / f"replay-{i}.bin", layout, size, budget, make_sampler(hyper, min(size, budget))
        )
        for i in range(count)
    ]


def _map_file(path: Path, size: int) -> mmap.mmap:
    try:
        make_folder(path.parent)
        file = regular(path, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise UsageError(f"{path}: cannot be opened: {error.strerror}") from None
    try:
        size = max(size, os.fstat(file).st_size)
        reserve(file, size)
        return mmap.mmap(file, size)
    except (OSError, OverflowError) as error:
        raise UsageError(
            f"{path}: cannot reserve {size / 1e6:.0f} MB for the replay: {error}; "
            "free space or lower --replay-size"
        ) from None
    finally:
        os.close(file)

"""How rows of a replay are drawn: what every kind of drawing does, and the uniform one.

Each kind is one small object beside the ring: it hears of every row and episode, draws row
numbers from the window, takes the errors of an update and goes to the checkpoint as arrays.
"""

from typing import NamedTuple, Protocol

import numpy as np

from pacesetter.types import Arrays, Floats, Numbers, Reals, Shape


class Drawn(NamedTuple):
    """Row numbers of a shape, and their importance weights (None: all 1)."""

    numbers: Numbers
    weight: Floats | None


class Drawing(Protocol):
    """What the replay and the members tell of rows, and ask for."""

    def add(self, number: int, member: int, earned: float) -> None:
        """Row `number` was written by a member whose episode had earned so much before it."""
        ...

    def end(self, member: int, total: float | None) -> None:
        """A member's episode ended with a return; None if it broke off unfinished."""
        ...

    def draw(self, rng: np.random.Generator, shape: Shape, window: range, done: float) -> Drawn:
        """Minibatches (..., B) from the rows in the window; `done` is the share of the horizon."""
        ...

    def feedback(self, numbers: Numbers, error: Floats) -> None:
        """Absolute errors (U, B) of drawn rows, before any further row is added."""
        ...

    def arrays(self, window: range) -> Arrays:
        """Everything that a checkpoint must hold."""
        ...

    def restore(self, arrays: Arrays, window: range) -> None:
        """The inverse of `arrays`; errors are those of foreign arrays (storage.FAULTS)."""
        ...


class Uniform:
    """Every row of the window alike, with replacement."""

    def add(self, number: int, member: int, earned: float) -> None: ...

    def end(self, member: int, total: float | None) -> None: ...

    def draw(self, rng: np.random.Generator, shape: Shape, window: range, done: float) -> Drawn:
        return Drawn(window.start + rng.integers(len(window), size=shape), None)

    def feedback(self, numbers: Numbers, error: Floats) -> None: ...

    def arrays(self, window: range) -> Arrays:
        return {}

    def restore(self, arrays: Arrays, window: range) -> None: ...


def weigh(priority: Reals, importance: float, done: float) -> Floats | None:
    """Importance weights (N P) ** -beta over the largest of each minibatch (..., B).

    Beta goes from `importance` to 1 with the share `done` of the horizon; from 0 it never starts.
    """
    if importance == 0:
        return None
    beta = importance + (1 - importance) * done
    smallest = priority.min(axis=-1, keepdims=True)
    return ((smallest / priority) ** beta).astype(np.float32)

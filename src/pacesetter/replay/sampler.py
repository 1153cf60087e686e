"""Which transitions of a replay a minibatch takes: uniformly, if no other sampler is used.

A sampler stands beside the ring. It hears of every row and episode, samples row numbers from the
window, takes the errors of an update and goes to the checkpoint as arrays.
"""

from typing import NamedTuple

import numpy as np

from pacesetter.types import Arrays, Floats, Numbers, Reals, Shape


class SampledIndices(NamedTuple):
    """Row numbers of a shape, and their importance weights (None: all 1)."""

    numbers: Numbers
    weight: Floats | None


class Sampler:
    """Samples every row of the window with the same probability, with replacement; others override
    what they need.
    """

    def add(self, number: int, env: int, earned: float) -> None:
        """Env `env` wrote row `number`; its episode had returned `earned` before that step."""

    def end(self, env: int, total: float | None) -> None:
        """The episode of env `env` ended with a return; None if it was abandoned unfinished."""

    def sample(
        self, rng: np.random.Generator, shape: Shape, window: range, done: float
    ) -> SampledIndices:
        """Minibatches (..., B) from the rows in the window; `done` is the share of the horizon."""
        return SampledIndices(window.start + rng.integers(len(window), size=shape), None)

    def feedback(self, numbers: Numbers, td_error: Floats) -> None:
        """Absolute TD errors (U, B) of sampled rows, before any further row is added."""

    def arrays(self, window: range) -> Arrays:
        """Everything that a checkpoint must hold."""
        return {}

    def restore(self, arrays: Arrays, window: range) -> None:
        """The inverse of `arrays`; errors are those of foreign arrays (storage.FAULTS)."""


def importance_weights(priority: Reals, importance: float, done: float) -> Floats | None:
    """Weights (N P) ** -beta over the largest of each minibatch (..., B).

    Beta goes from `importance` to 1 with the share `done` of the horizon; 0 switches weights off.
    """
    if importance == 0:
        return None
    beta = importance + (1 - importance) * done
    smallest = priority.min(axis=-1, keepdims=True)
    return ((smallest / priority) ** beta).astype(np.float32)

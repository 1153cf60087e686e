"""The transition: the one place that says what a row of the replay holds.

Packing, unpacking, the row's width, the n-step queue, the rollout and what a learner gets as a
minibatch all follow from `Transition`. A new column is one field here and one shape in `Layout`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from pacesetter.types import Floats, Shape


class Spec(NamedTuple):
    """Sizes of the task's vectors; actions are in [-1, 1] on this side of the env border."""

    observation_size: int
    action_size: int


class Transition(NamedTuple):
    """One transition or many: minibatches (U, B, ...), or a rollout in time order (T, E, ...).

    Over m steps (`--n-step`): the first step's observation, action and mask, the discounted sum
    of rewards, and the last step's next observation.
    """

    observation: Any
    action: Any  # in [-1, 1]
    reward: Any
    next_observation: Any  # what step() returned, never a reset observation
    discount: Any  # gamma**m * (1 - terminated)
    last: Any  # the episode ended here: terminated or truncated
    mask: Any  # bootstrap mask (..., N); N may be 0
    # What follows is not part of a row.
    earned: Any = None  # what the member's episode had returned before this transition
    weight: Any = None  # importance weight, 1 if sampled uniformly
    starts: Any = None  # reset observations, for imagined episodes
    valid: Any = None  # number of valid rows of a padded replay
    return_deviation: Any = None  # running standard deviation of discounted returns


Batch = Transition  # many of them, as JAX arrays


class Layout:
    """Where each part of a transition stands in a packed float32 row."""

    def __init__(self, spec: Spec, masks: int = 0) -> None:
        observation, action = spec
        self.shapes: dict[str, Shape] = {
            "observation": (observation,),
            "action": (action,),
            "reward": (),
            "next_observation": (observation,),
            "discount": (),
            "last": (),
            "mask": (masks,),
        }
        ends: list[int] = np.cumsum([math.prod(shape) for shape in self.shapes.values()]).tolist()
        self.width = ends[-1]  # numbers in a row
        self._places = {
            name: slice(start, end)
            for name, start, end in zip(self.shapes, [0, *ends], ends, strict=False)
        }

    def pack(self, transition: Transition) -> Floats:
        """The row (width,) of one transition."""
        row = np.empty(self.width, np.float32)
        for name, place in self._places.items():
            row[place] = getattr(transition, name)
        return row

    def unpack(self, rows: Any) -> Transition:
        """The transitions in rows (..., width), of NumPy or of JAX, without weights."""
        parts = {
            name: rows[..., place].reshape(*rows.shape[:-1], *self.shapes[name])
            for name, place in self._places.items()
        }
        return Transition(**parts)

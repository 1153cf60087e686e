"""Rows that reach over several steps, built for each member as its steps come in."""

from typing import Any, NamedTuple

import numpy as np

from pacesetter.policy import Floats
from pacesetter.storage import Arrays


class Transition(NamedTuple):
    """One row before it is packed, in the order of `Replay.add`.

    Over m steps: the first's observation, action, mask and `earned`, what the episode had earned
    before it; the discounted sum of rewards; where the last step led, and gamma**m, or 0.
    """

    observation: Floats
    action: Floats
    reward: float
    following: Floats
    discount: float
    last: bool
    mask: Floats
    earned: float


class Pending:
    """One member's rows that still wait for steps, oldest first; each is shorter by a step."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.rows: list[Transition] = []

    def push(self, step: Transition) -> list[Transition]:
        """Take in a step; the rows that are complete with it, which at an episode's end are all."""
        if self.steps == 1:
            return [step]
        self.rows = [_extend(row, step) for row in self.rows] + [step]
        if step.last:
            return self.flush()
        return [self.rows.pop(0)] if len(self.rows) == self.steps else []

    def flush(self) -> list[Transition]:
        """All rows as they are, because no further step will follow."""
        rows, self.rows = self.rows, []
        return rows

    def arrays(self) -> Arrays:
        """The waiting rows, field by field."""
        fields = zip(*self.rows, strict=True)
        return {
            name: np.array(values) for name, values in zip(Transition._fields, fields, strict=False)
        }

    def restore(self, arrays: Arrays) -> None:
        """The inverse of `arrays`."""
        columns: list[Any] = [arrays[name] for name in Transition._fields if name in arrays]
        self.rows = [Transition(*row) for row in zip(*columns, strict=True)]


def _extend(row: Transition, step: Transition) -> Transition:
    """A row with one more step, seen from where it led; only its own end would make that 0."""
    return row._replace(
        reward=row.reward + row.discount * step.reward,
        following=step.following,
        discount=row.discount * step.discount,
        last=step.last,
    )

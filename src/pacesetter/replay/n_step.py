"""Transitions over several steps (`--n-step`), built for each member as its steps come in."""

from typing import Any

import numpy as np

from pacesetter.batch import Transition
from pacesetter.types import Arrays


class NStepQueue:
    """One member's transitions that still wait for steps, oldest first."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.rows: list[Transition] = []

    def push(self, step: Transition) -> list[Transition]:
        """Add a step; the transitions that are now complete, at an episode's end all of them."""
        if self.steps == 1:
            return [step]
        self.rows = [_extend(row, step) for row in self.rows] + [step]
        if step.last:
            return self.flush()
        return [self.rows.pop(0)] if len(self.rows) == self.steps else []

    def flush(self) -> list[Transition]:
        """All transitions as they are, because no further step will follow."""
        rows, self.rows = self.rows, []
        return rows

    def arrays(self) -> Arrays:
        """The waiting transitions, field by field."""
        fields = zip(Transition._fields, zip(*self.rows, strict=True), strict=False)
        return {name: np.array(values) for name, values in fields if values[0] is not None}

    def table(self) -> dict[str, Any]:
        return {}

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `arrays`."""
        columns: list[Any] = list(arrays.values())
        rows = zip(*columns, strict=True)
        self.rows = [Transition(**dict(zip(arrays, row, strict=True))) for row in rows]


def _extend(row: Transition, step: Transition) -> Transition:
    """A transition that waits, with one more step."""
    return row._replace(
        reward=row.reward + row.discount * step.reward,
        next_observation=step.next_observation,
        discount=row.discount * step.discount,
        last=step.last,
    )

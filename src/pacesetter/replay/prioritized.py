"""Rows sampled by their last TD error: PER and LAP.

Priorities lie at `number % size`, so a new row takes the place of the one that left the window.
"""

from collections.abc import Callable

import numpy as np

from pacesetter.replay.sampler import SampledIndices, Sampler, importance_weights
from pacesetter.types import Arrays, Floats, Numbers, Reals, Shape

BLOCK = 32  # priorities per sum
REFRESH = 250  # updates after which the priority of new rows is computed again (TD7)
SMALLEST = 1e-6  # added to an error, so that no row is lost (Schaul et al. 2016, 3.3)


def _proportional(error: Reals) -> Reals:
    return error + SMALLEST


def _at_least_one(error: Reals) -> Reals:
    return np.maximum(error, 1.0)


MEASURES: dict[str, Callable[[Reals], Reals]] = {
    "prioritized": _proportional,
    "lap": _at_least_one,
}


class ByError(Sampler):
    """Rows in proportion to a power of their last TD error: PER (Schaul et al. 2016), and LAP
    (Fujimoto et al. 2020, sfujim/TD7) with its own measure of the error and without weights.

    Departures: weights are divided by the largest of their minibatch, not of the whole replay;
    new rows take the largest priority, computed again every 250 updates for PER too, so that one
    early error does not put them first for ever; sampling is stratified for LAP too.
    """

    def __init__(
        self, size: int, exponent: float, importance: float, measure: Callable[[Reals], Reals]
    ) -> None:
        self.exponent, self.importance, self.measure = exponent, importance, measure
        self.tree = SumTree(size)
        self.largest = 1.0
        self.updates = 0
        self.known = 0  # rows below this number have a priority

    def sample(
        self, rng: np.random.Generator, shape: Shape, window: range, done: float
    ) -> SampledIndices:
        self._admit(window)
        strata = (np.arange(shape[-1]) + rng.random(shape)) / shape[-1]
        strata = rng.permuted(strata, axis=-1)  # rows in any order, as STEVE deals them by place
        places = self.tree.find(strata)
        newest = window.stop - 1
        numbers = newest - (newest - places) % self.tree.size
        return SampledIndices(
            numbers, importance_weights(self.tree.values[places], self.importance, done)
        )

    def feedback(self, numbers: Numbers, td_error: Floats) -> None:
        priority = self.measure(td_error.astype(np.float64)) ** self.exponent
        self.tree.put(numbers % self.tree.size, priority)
        before, self.updates = self.updates, self.updates + len(td_error)
        if self.updates // REFRESH > before // REFRESH:
            self.largest = float(self.tree.values.max())
        else:
            self.largest = max(self.largest, float(priority.max()))

    def arrays(self, window: range) -> Arrays:
        self._admit(window)
        counters = np.array([self.largest, self.updates])
        return {"values": self.tree.values[: len(window)], "counters": counters}

    def restore(self, arrays: Arrays, window: range) -> None:
        self.tree = SumTree(max(self.tree.size, len(window)))
        self.tree.put(np.arange(len(window)), arrays["values"])
        self.largest, self.updates = float(arrays["counters"][0]), int(arrays["counters"][1])
        self.known = window.stop

    def _admit(self, window: range) -> None:
        """Give rows that were added since the last sample the largest priority, all at once."""
        new = np.arange(max(self.known, window.start), window.stop)
        self.tree.put(new % self.tree.size, np.full(len(new), self.largest))
        self.known = window.stop


class SumTree:
    """Priorities (size,) and the sum of each block of them; two levels are fastest in NumPy.

    A sum is always computed over its whole block, so it is a function of the priorities alone.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.blocks: Reals = np.zeros((-(-size // BLOCK), BLOCK))
        self.values = self.blocks.reshape(-1)
        self.sums: Reals = np.zeros(len(self.blocks))

    def put(self, places: Numbers, values: Reals) -> None:
        """Set priorities; of a place that comes twice, the last value stays."""
        self.values[places.reshape(-1)] = values.reshape(-1)
        touched = np.unique(places // BLOCK)
        self.sums[touched] = self.blocks[touched].sum(axis=1)

    def find(self, shares: Reals) -> Numbers:
        """The place at which each share [0, 1) of the total is reached; never one of priority 0."""
        ends = self.sums.cumsum()
        block, rest = _reach(ends[None], shares.reshape(-1) * ends[-1])
        inner = self.blocks[block].cumsum(axis=1)
        within, _ = _reach(inner, rest)
        return (block * BLOCK + within).reshape(shares.shape)


def _reach(ends: Reals, mass: Reals) -> tuple[Numbers, Reals]:
    """Where rows of running sums (1 or N, M) first exceed each mass (N,), and what is left of it.

    Rounding may carry a mass to the last sum, where nothing would exceed it.
    """
    mass = np.minimum(mass, np.nextafter(ends[:, -1], 0))
    if len(ends) == 1:
        found = ends[0].searchsorted(mass, side="right")
        row = np.zeros_like(found)
    else:
        found = (ends > mass[:, None]).argmax(axis=1)
        row = np.arange(len(ends))
    return found, mass - np.where(found > 0, ends[row, found - 1], 0.0)

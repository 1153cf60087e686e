"""Rows drawn by their last TD error: PER and LAP.

Priorities lie at `number % size`, so a new row takes the place of the one that left the window.
"""

from collections.abc import Callable

import numpy as np

from pacesetter.replay.sampler import Drawn, weigh
from pacesetter.types import Arrays, Floats, Numbers, Reals, Shape

BLOCK = 32  # priorities that are summed together
REFRESH = 250  # updates after which the priority of new rows is measured anew (TD7)
SMALLEST = 1e-6  # added to an error, so that no row is lost (Schaul et al. 2016, 3.3)


def _proportional(error: Reals) -> Reals:
    return error + SMALLEST


def _at_least_one(error: Reals) -> Reals:
    return np.maximum(error, 1.0)


MEASURES: dict[str, Callable[[Reals], Reals]] = {
    "prioritized": _proportional,
    "lap": _at_least_one,
}


class ByError:
    """Rows in proportion to a power of their last TD error: PER (Schaul et al. 2016), and LAP
    (Fujimoto et al. 2020, sfujim/TD7) with its own measure of the error and without weights.

    Departures: weights are divided by the largest of their minibatch, not of the whole replay;
    new rows take the largest priority, measured anew every 250 updates for PER too, lest one
    early error puts them first for ever; draws are stratified for LAP too.
    """

    def __init__(
        self, size: int, exponent: float, importance: float, measure: Callable[[Reals], Reals]
    ) -> None:
        self.exponent, self.importance, self.measure = exponent, importance, measure
        self.sums = Sums(size)
        self.largest = 1.0
        self.updates = 0
        self.known = 0  # rows below this number have a priority

    def add(self, number: int, member: int, earned: float) -> None: ...

    def end(self, member: int, total: float | None) -> None: ...

    def draw(self, rng: np.random.Generator, shape: Shape, window: range, done: float) -> Drawn:
        self._admit(window)
        strata = (np.arange(shape[-1]) + rng.random(shape)) / shape[-1]
        places = self.sums.find(strata)
        newest = window.stop - 1
        numbers = newest - (newest - places) % self.sums.size
        return Drawn(numbers, weigh(self.sums.values[places], self.importance, done))

    def feedback(self, numbers: Numbers, error: Floats) -> None:
        priority = self.measure(error.astype(np.float64)) ** self.exponent
        self.sums.put(numbers % self.sums.size, priority)
        before, self.updates = self.updates, self.updates + len(error)
        if self.updates // REFRESH > before // REFRESH:
            self.largest = float(self.sums.values.max())
        else:
            self.largest = max(self.largest, float(priority.max()))

    def arrays(self, window: range) -> Arrays:
        self._admit(window)
        counters = np.array([self.largest, self.updates])
        return {"values": self.sums.values[: len(window)], "counters": counters}

    def restore(self, arrays: Arrays, window: range) -> None:
        self.sums = Sums(max(self.sums.size, len(window)))
        self.sums.put(np.arange(len(window)), arrays["values"])
        self.largest, self.updates = float(arrays["counters"][0]), int(arrays["counters"][1])
        self.known = window.stop

    def _admit(self, window: range) -> None:
        """Give rows that came since the last draw the largest priority, all at once."""
        new = np.arange(max(self.known, window.start), window.stop)
        self.sums.put(new % self.sums.size, np.full(len(new), self.largest))
        self.known = window.stop


class Sums:
    """Priorities (size,) and the sum of each block of them; two levels are the quickest in NumPy.

    A sum is always taken anew over its block, so it is a function of the priorities alone.
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

"""How rows of a replay are drawn: uniformly, by TD error (PER, LAP) or by episode return.

Each kind is one small object beside the ring: it hears of every row and episode, draws row
numbers from the window, takes the errors of an update and goes to the checkpoint as arrays.
Priorities lie at `number % size`, so a new row takes the place of the one that left the window.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pacesetter.policy import Floats
from pacesetter.storage import Arrays

Numbers = NDArray[np.int64]
Reals = NDArray[np.float64]
Shape = tuple[int, ...]

BLOCK = 32  # priorities that are summed together
REFRESH = 250  # updates after which the priority of new rows is measured anew (TD7)
SMALLEST = 1e-6  # added to an error, so that no row is lost (Schaul et al. 2016, 3.3)
FLOOR = 0.05  # added to a rank, likewise
MIDDLE = 0.5  # rank of what has none yet
REFERENCE = 4096  # rows that returns-to-go are ranked among


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


def choose(hyper: Any, size: int) -> Drawing:
    """The drawing that settings ask for, of a replay with at most `size` rows."""
    exponent, importance = hyper.exponents
    if hyper.replay == "uniform":
        return Uniform()
    if hyper.replay == "return":
        return ByReturn(size, exponent, importance, hyper.replay_to_go)
    return ByError(size, exponent, importance, MEASURES[hyper.replay])


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


class ByReturn:
    """Rows of well-paid episodes more often: the future work of the Multi-TD3 paper.

    An episode's rank u in (0, 1) is that of its return among the finished episodes in the window,
    ties in their middle; its rows have priority (0.05 + u) ** exponent, those of running episodes
    as in the middle. With `to_go` each row has its own rank, by the undiscounted return from it to
    the episode's end. Ranks know neither scale nor sign of returns. Priorities are bounded, so
    rows are drawn uniformly and kept in proportion: exact, and what left the window needs no care.
    """

    def __init__(self, size: int, exponent: float, importance: float, to_go: bool) -> None:
        self.size, self.exponent, self.importance, self.to_go = size, exponent, importance, to_go
        self.scores: Reals = np.full(size, np.nan)  # what rows are ranked by, once it is known
        self.running: dict[int, list[tuple[int, float]]] = {}  # rows and what was earned before
        self.ended: deque[tuple[float, int]] = deque()  # returns and last rows of episodes
        self.ranking: Reals = np.zeros(0)  # sorted scores
        self.head = 0

    def add(self, number: int, member: int, earned: float) -> None:
        self.scores[number % self.size] = np.nan
        self.running.setdefault(member, []).append((number, earned))
        self.head = number + 1

    def end(self, member: int, total: float | None) -> None:
        rows = [row for row in self.running.pop(member, []) if row[0] >= self.head - self.size]
        if total is None or not rows:
            return
        for number, earned in rows:
            self.scores[number % self.size] = total - earned if self.to_go else total
        self.ended.append((total, rows[-1][0]))
        while self.ended[0][1] < self.head - self.size:
            self.ended.popleft()
        self.ranking = np.sort(self._scored())

    def draw(self, rng: np.random.Generator, shape: Shape, window: range, done: float) -> Drawn:
        count = int(np.prod(shape))
        found: Numbers = np.zeros(0, np.int64)
        priorities: Reals = np.zeros(0)
        while len(found) < count:
            numbers = window.start + rng.integers(len(window), size=2 * count)
            priority = self.priority(numbers)
            kept = rng.random(2 * count) < priority
            found = np.concatenate([found, numbers[kept]])
            priorities = np.concatenate([priorities, priority[kept]])
        weight = weigh(priorities[:count].reshape(shape), self.importance, done)
        return Drawn(found[:count].reshape(shape), weight)

    def priority(self, numbers: Numbers) -> Reals:
        """Priorities of rows, as shares of the largest that there can be."""
        scores = self.scores[numbers % self.size]
        below, above = (self.ranking.searchsorted(scores, side) for side in ("left", "right"))
        rank = (below + above) / max(2 * len(self.ranking), 1)
        rank = np.where(np.isnan(scores), MIDDLE, rank)
        return ((FLOOR + rank) / (FLOOR + 1)) ** self.exponent

    def feedback(self, numbers: Numbers, error: Floats) -> None: ...

    def arrays(self, window: range) -> Arrays:
        rows = [(member, *row) for member, rows in self.running.items() for row in rows]
        return {
            "scores": self.scores[: len(window)],
            "ranking": self.ranking,
            "ended": np.array(self.ended, np.float64).reshape(-1, 2),
            "running": np.array(rows, np.float64).reshape(-1, 3),
        }

    def restore(self, arrays: Arrays, window: range) -> None:
        self.size = max(self.size, len(window))
        self.scores = np.full(self.size, np.nan)
        self.scores[: len(window)] = arrays["scores"]
        self.ranking = arrays["ranking"]
        self.ended = deque((float(total), int(last)) for total, last in arrays["ended"])
        self.running = {}
        for member, number, earned in arrays["running"]:
            self.running.setdefault(int(member), []).append((int(number), float(earned)))
        self.head = window.stop

    def _scored(self) -> Reals:
        """One score an episode; to go, those of evenly spaced rows, which are sorted quickly."""
        if not self.to_go:
            return np.array([total for total, _ in self.ended])
        filled = min(self.head, self.size)
        scores = self.scores[: filled : -(-filled // REFERENCE)]
        return scores[~np.isnan(scores)]


def weigh(priority: Reals, importance: float, done: float) -> Floats | None:
    """Importance weights (N P) ** -beta over the largest of each minibatch (..., B).

    Beta goes from `importance` to 1 with the share `done` of the horizon; from 0 it never starts.
    """
    if importance == 0:
        return None
    beta = importance + (1 - importance) * done
    smallest = priority.min(axis=-1, keepdims=True)
    return ((smallest / priority) ** beta).astype(np.float32)

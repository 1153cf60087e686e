"""Rows sampled by the return of their episode, or by their return-to-go."""

from collections import deque

import numpy as np

from pacesetter.replay.sampler import SampledIndices, Sampler, importance_weights
from pacesetter.types import Arrays, Numbers, Reals, Shape

FLOOR = 0.05  # added to a rank, so that no row is lost
MIDDLE = 0.5  # rank of what has none yet
REFERENCE = 4096  # rows that returns-to-go are ranked among


class ByReturn(Sampler):
    """Samples episodes with high returns more often: the future work of the Multi-TD3 paper.

    An episode's rank u in (0, 1) is that of its return among the finished episodes in the window;
    ties share the mean rank. Its rows have priority (0.05 + u) ** exponent; rows of running
    episodes take u = 0.5. With `to_go` each row has its own rank in [0, 1], by its undiscounted
    return-to-go among those of at most 4,096 rows. Ranks depend on neither scale nor sign of
    returns. Priorities are bounded, so rejection sampling is exact, and rows that left the window
    need no care.
    """

    def __init__(self, size: int, exponent: float, importance: float, to_go: bool) -> None:
        self.size, self.exponent, self.importance, self.to_go = size, exponent, importance, to_go
        self.scores: Reals = np.full(size, np.nan)  # what rows are ranked by, once it is known
        self.running: dict[int, list[tuple[int, float]]] = {}  # rows and what was earned before
        self.ended: deque[tuple[float, int]] = deque()  # returns and last rows of episodes
        self.ranking: Reals = np.zeros(0)  # sorted scores
        self.head = 0

    def add(self, number: int, env: int, earned: float) -> None:
        self.scores[number % self.size] = np.nan
        self.running.setdefault(env, []).append((number, earned))
        self.head = number + 1

    def end(self, env: int, total: float | None) -> None:
        rows = [row for row in self.running.pop(env, []) if row[0] >= self.head - self.size]
        if total is None or not rows:
            return
        for number, earned in rows:
            self.scores[number % self.size] = total - earned if self.to_go else total
        self.ended.append((total, rows[-1][0]))
        gone: list[float] = []
        while self.ended[0][1] < self.head - self.size:
            gone.append(self.ended.popleft()[0])
        if self.to_go:
            self.ranking = np.sort(self._sampled())
        else:  # kept sorted: a full sort would cost more with every short episode
            for score in gone:  # one by one, since several may be equal
                self.ranking = np.delete(self.ranking, self.ranking.searchsorted(score))
            self.ranking = np.insert(self.ranking, self.ranking.searchsorted(total), total)

    def sample(
        self, rng: np.random.Generator, shape: Shape, window: range, done: float
    ) -> SampledIndices:
        count = int(np.prod(shape))
        found: Numbers = np.zeros(0, np.int64)
        priorities: Reals = np.zeros(0)
        while len(found) < count:
            numbers = window.start + rng.integers(len(window), size=2 * count)
            priority = self.priority(numbers)
            kept = rng.random(2 * count) < priority
            found = np.concatenate([found, numbers[kept]])
            priorities = np.concatenate([priorities, priority[kept]])
        weight = importance_weights(priorities[:count].reshape(shape), self.importance, done)
        return SampledIndices(found[:count].reshape(shape), weight)

    def priority(self, numbers: Numbers) -> Reals:
        """Priorities of rows, as shares of the largest that there can be."""
        scores = self.scores[numbers % self.size]
        below, above = (self.ranking.searchsorted(scores, side) for side in ("left", "right"))
        rank = (below + above) / max(2 * len(self.ranking), 1)
        rank = np.where(np.isnan(scores), MIDDLE, rank)
        return ((FLOOR + rank) / (FLOOR + 1)) ** self.exponent

    def arrays(self, window: range) -> Arrays:
        rows = [(env, *row) for env, rows in self.running.items() for row in rows]
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
        self.ended = deque((float(total), int(last)) for total, last in arrays["ended"])
        totals = np.sort(np.array([total for total, _ in self.ended]))
        self.ranking = arrays["ranking"] if self.to_go else totals
        self.running = {}
        for env, number, earned in arrays["running"]:
            self.running.setdefault(int(env), []).append((int(number), float(earned)))
        self.head = window.stop

    def _sampled(self) -> Reals:
        """Scores of evenly spaced rows, which are sorted quickly."""
        filled = min(self.head, self.size)
        scores = self.scores[: filled : -(-filled // REFERENCE)]
        return scores[~np.isnan(scores)]

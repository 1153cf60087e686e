"""Running mean and standard deviation of observations, in float64, shared by all members."""

from typing import Any

import numpy as np

from pacesetter.learner.tree_arrays import rebuild
from pacesetter.policy import normalize
from pacesetter.types import Arrays, Floats, Reals

Statistics = tuple[Floats, Floats]


class Normalizer:
    """Welford's sums; evaluation never adds to them. Disabled, it changes nothing."""

    def __init__(self, size: int, enabled: bool) -> None:
        self.enabled = enabled
        self.sums: Reals = np.zeros((3, size))  # count, mean, squared deviations
        self._statistics: Statistics | None = None  # of these sums, once asked for

    def add(self, observation: Floats) -> None:
        """Add one observation (O,)."""
        if not self.enabled:
            return
        _add(self.sums, observation)
        self._statistics = None

    def statistics(self) -> Statistics:
        """Mean and standard deviation, each (O,); 0 and 1 before there are two observations."""
        if self._statistics is None:
            count, mean, squares = self.sums
            if count[0] < 2:
                found = np.zeros(len(mean), np.float32), np.ones(len(mean), np.float32)
            else:
                deviation = np.sqrt(squares / count + 1e-8)
                found = mean.astype(np.float32), deviation.astype(np.float32)
            self._statistics = found
        return self._statistics

    def scale(self, observation: Floats) -> Floats:
        """An observation as learners see it."""
        return normalize(observation, *self.statistics()) if self.enabled else observation

    def arrays(self) -> Arrays:
        return {"sums": self.sums}

    def table(self) -> dict[str, Any]:
        return {}

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `arrays`."""
        self.sums, self._statistics = rebuild({"sums": self.sums}, arrays)["sums"], None


class ReturnScale:
    """Running standard deviation of discounted returns, by which a learner may divide rewards.

    An env's return is that so far: its rewards, each discounted by its age; it begins anew with
    each episode. All of them, of all envs and steps, are one sample (as in SimbaV2 and XQC).
    """

    def __init__(self, gamma: float, envs: int) -> None:
        self.gamma = gamma
        self.running: Reals = np.zeros(envs)
        self.sums: Reals = np.zeros(3)  # count, mean, squared deviations

    def add(self, env: int, reward: float, last: bool) -> None:
        """Add a step of an env."""
        self.running[env] = total = self.gamma * self.running[env] + reward
        _add(self.sums, total)
        if last:
            self.running[env] = 0.0

    @property
    def deviation(self) -> np.float32:
        """It; 1 as long as all returns are equal."""
        count, _, squares = self.sums
        return np.float32(np.sqrt(squares / count)) if squares > 0 else np.float32(1)

    def arrays(self) -> Arrays:
        return {"running": self.running.copy(), "sums": self.sums.copy()}

    def table(self) -> dict[str, Any]:
        return {}

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `arrays`."""
        found = rebuild({"running": self.running, "sums": self.sums}, arrays)
        self.running, self.sums = found["running"].copy(), found["sums"].copy()


def _add(sums: Reals, value: Any) -> None:
    """One value more for count, mean and squared deviations (3, ...), in place (Welford)."""
    sums[0] += 1
    change = value - sums[1]
    sums[1] += change / sums[0]
    sums[2] += change * (value - sums[1])

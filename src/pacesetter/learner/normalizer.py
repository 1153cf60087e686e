"""Running mean and deviation of observations, in float64, shared by all members."""

import numpy as np
from numpy.typing import NDArray

from pacesetter.types import Floats

Statistics = tuple[Floats, Floats]


class Normalizer:
    """Welford's sums; evaluation never adds to them."""

    def __init__(self, size: int) -> None:
        self.sums: NDArray[np.float64] = np.zeros((3, size))  # count, mean, squared deviations

    def add(self, observation: Floats) -> None:
        """Take in one observation (O,)."""
        count, mean, squares = self.sums
        count += 1
        change = observation - mean
        mean += change / count
        squares += change * (observation - mean)

    def statistics(self) -> Statistics:
        """Mean and deviation, each (O,); 0 and 1 before there are two observations."""
        count, mean, squares = self.sums
        if count[0] < 2:
            return np.zeros(len(mean), np.float32), np.ones(len(mean), np.float32)
        deviation = np.sqrt(squares / count + 1e-8)
        return mean.astype(np.float32), deviation.astype(np.float32)

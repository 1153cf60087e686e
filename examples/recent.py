"""A sampler of your own: newer transitions more often (see docs/howto/replay.md)."""

import numpy as np

from pacesetter.replay.sampler import SampledIndices, Sampler
from pacesetter.types import Shape


class Recent(Sampler):
    """Samples a row of age a (0 newest, 1 oldest) with a density of 1 / (2 sqrt(a))."""

    def sample(
        self, rng: np.random.Generator, shape: Shape, window: range, done: float
    ) -> SampledIndices:
        age = (rng.random(shape) ** 2 * len(window)).astype(np.int64)
        return SampledIndices(window.stop - 1 - age, None)

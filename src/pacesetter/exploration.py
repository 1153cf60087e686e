"""Action noise, as pairs of functions: what an episode starts with, and one step of it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pacesetter.policy import Floats

OU_PULL = 0.15
Draw = np.random.Generator


class Exploration(NamedTuple):
    """`begin(size) -> memory` at an episode's start; `noise(memory, scale, size, rng)` a step."""

    begin: Callable[[int], Any]
    noise: Callable[[Any, float, int, Draw], tuple[Floats, Any]]


def _gaussian(memory: Any, scale: float, size: int, rng: Draw) -> tuple[Floats, Any]:
    return np.float32(scale) * rng.standard_normal(size, np.float32), memory


def _ou(memory: Floats, scale: float, size: int, rng: Draw) -> tuple[Floats, Any]:
    kick = np.float32(scale) * rng.standard_normal(size, np.float32)
    moved = np.add((1 - OU_PULL) * memory, kick, dtype=np.float32)
    return moved, moved


KINDS = {
    "gaussian": Exploration(lambda size: (), _gaussian),
    # Ornstein-Uhlenbeck with theta 0.15 and unit time step (Lillicrap et al. 2016, section 7).
    "ou": Exploration(lambda size: np.zeros(size, np.float32), _ou),
}

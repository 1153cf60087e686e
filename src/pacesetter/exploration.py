"""Action noise, as pairs of pure functions: what an episode starts with, and one step of it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array
OU_PULL = 0.15


class Exploration(NamedTuple):
    """`begin(size) -> memory` at an episode's start; `noise(memory, scale, key)` at each step."""

    begin: Callable[[int], Any]
    noise: Callable[[Any, float, Array, int], tuple[Array, Any]]


def _gaussian(memory: tuple[()], scale: float, key: Array, size: int) -> tuple[Array, tuple[()]]:
    return scale * jax.random.normal(key, (size,)), ()


def _ou(memory: Array, scale: float, key: Array, size: int) -> tuple[Array, Array]:
    memory = (1 - OU_PULL) * memory + scale * jax.random.normal(key, (size,))
    return memory, memory


KINDS = {
    "gaussian": Exploration(lambda size: (), _gaussian),
    # Ornstein-Uhlenbeck with theta 0.15 and unit time step (Lillicrap et al. 2016, section 7).
    "ou": Exploration(jnp.zeros, _ou),
}

"""The squashed Gaussian of SAC's kin: a tanh of mean plus noise, its density, its NumPy twin."""

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter.networks import mlp
from pacesetter.networks.forward import clip, forward
from pacesetter.networks.mlp import Array
from pacesetter.policy import Actors
from pacesetter.types import Floats, Layers

LOG_STD_RANGE = (-20.0, 2.0)


def sample(actor: mlp.Network, observation: Array, key: Array) -> tuple[Array, Array]:
    """An action (..., A) and its log-probability (...) in [-1, 1]."""
    return sample_from(mlp.apply(actor, observation), key)


def sample_from(outputs: Array, key: Array) -> tuple[Array, Array]:
    """The same from an actor's outputs (..., 2 A)."""
    mean, log_std = jnp.split(outputs, 2, axis=-1)
    log_std = jnp.clip(log_std, *LOG_STD_RANGE)
    noise = jax.random.normal(key, mean.shape)
    before = mean + jnp.exp(log_std) * noise
    return jnp.tanh(before), log_probability(before, noise, log_std)


def log_probability(before: Array, noise: Array, log_std: Array) -> Array:
    """log pi of tanh(before), before = mean + std * noise; stable where tanh saturates."""
    gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    far = -2 * jnp.abs(before)
    # With softplus, whose log1p is slow, an action takes three times as long and is no closer.
    squash = 2 * jnp.log(2.0) + far - 2 * jnp.log(1 + jnp.exp(far))
    return (gaussian - squash).sum(axis=-1)


def explore(actor: Layers, observation: Floats, rng: np.random.Generator) -> Floats:
    """An action (A,) drawn in NumPy."""
    outputs = forward(actor, observation)
    size = outputs.shape[-1] // 2  # np.split is slow for so few numbers
    mean, log_std = outputs[..., :size], outputs[..., size:]
    noise = rng.standard_normal(mean.shape, np.float32)
    return np.tanh(mean + np.exp(clip(log_std, *LOG_STD_RANGE)) * noise)


def mean_policy(actor: mlp.Network, size: int) -> Actors:
    """The deterministic action (size,): the tanh of the mean."""
    *hidden, last = actor
    mean = {name: value[..., :size] for name, value in last.items()}
    one = jax.tree.map(lambda x: x[None], (*hidden, mean))
    return Actors(one, activation="relu", output="tanh")

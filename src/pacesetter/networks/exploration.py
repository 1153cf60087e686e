"""How a deterministic actor explores: noise on its actions, or on its own weights."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator, ValidationInfo

from pacesetter.networks import mlp
from pacesetter.policy import Floats, Layers, forward

OU_PULL = 0.15
SPARSE_CHANCE = 0.05
ADAPT_EVERY = 50  # updates of a learner between two adaptations of its parameter noise
ADAPT_FACTOR = 1.01
SIGMA_RANGE = (1e-4, 1.0)  # where tanh saturates, distance no longer tells of sigma
NOISY = ("kernel", "bias")  # and not the gains of layer norm
Array = jax.Array
Draw = np.random.Generator


def _fits_all_layers(kind: str, info: ValidationInfo) -> str:
    if kind == "parameter" and not info.data.get("actor_layer_norm"):
        raise ValueError("needs --actor-layer-norm, so that one deviation fits all layers")
    return kind


Kind = Annotated[Literal["gaussian", "ou", "sparse", "parameter"], AfterValidator(_fits_all_layers)]


class Exploration(NamedTuple):
    """`begin(acting, size, rng) -> memory` at an episode's start; then, a step,
    `act(acting, memory, observation, scale, rng) -> (action, memory)`.
    """

    begin: Callable[[Any, int, Draw], Any]
    act: Callable[[Any, Any, Floats, float, Draw], tuple[Floats, Any]]


def _normal(shape: tuple[int, ...], scale: float, rng: Draw) -> Floats:
    return np.float32(scale) * rng.standard_normal(shape, np.float32)


def _gaussian(
    actor: Layers, memory: Any, observation: Floats, scale: float, rng: Draw
) -> tuple[Floats, Any]:
    action: Floats = np.tanh(forward(actor, observation))
    return action + _normal(action.shape, scale, rng), memory


def _ou(
    actor: Layers, memory: Floats, observation: Floats, scale: float, rng: Draw
) -> tuple[Floats, Any]:
    moved = np.add((1 - OU_PULL) * memory, _normal(memory.shape, scale, rng), dtype=np.float32)
    return np.tanh(forward(actor, observation)) + moved, moved


def _sparse(
    actor: Layers, memory: Any, observation: Floats, scale: float, rng: Draw
) -> tuple[Floats, Any]:
    before = forward(actor, observation)
    chosen = rng.random(before.shape) < SPARSE_CHANCE
    return np.tanh(before + _normal(before.shape, scale, rng) * chosen), memory


def _noisy_actor(acting: tuple[Layers, Any], size: int, rng: Draw) -> Layers:
    actor, sigma = acting

    def noisy(value: Floats) -> Floats:
        return value + _normal(value.shape, sigma, rng)

    return tuple(
        {name: noisy(value) if name in NOISY else value for name, value in layer.items()}
        for layer in actor
    )


def _by_noisy_actor(
    acting: Any, memory: Layers, observation: Floats, scale: float, rng: Draw
) -> tuple[Floats, Any]:
    return np.tanh(forward(memory, observation)), memory


KINDS = {
    "gaussian": Exploration(lambda acting, size, rng: (), _gaussian),
    # Ornstein-Uhlenbeck with theta 0.15 and unit time step (Lillicrap et al. 2016, section 7).
    "ou": Exploration(lambda acting, size, rng: np.zeros(size, np.float32), _ou),
    # STEVE (Buckman et al. 2018): noise before the tanh, on each number with a chance of 5%.
    "sparse": Exploration(lambda acting, size, rng: (), _sparse),
    # Plappert et al. 2018: one actor with noisy weights acts a whole episode, without other noise.
    "parameter": Exploration(_noisy_actor, _by_noisy_actor),
}


def first_sigma(goal: float) -> Array:
    """Deviation of the weights' noise at the start: the goal itself."""
    return jnp.clip(jnp.asarray(goal, jnp.float32), *SIGMA_RANGE)


def adapt_sigma(
    sigma: Array, actor: mlp.Network, goal: float, observation: Array, key: Array
) -> Array:
    """Sigma moved 1% towards where noisy actions are `goal` from clean ones (Plappert et al. 2018,
    appendix C), on a batch of observations (B, O) and with a noisy copy drawn for this alone.
    """
    apart = mlp.actor(perturb(actor, sigma, key), observation) - mlp.actor(actor, observation)
    distance = jnp.sqrt((apart**2).mean())
    moved = jnp.where(distance > goal, sigma / ADAPT_FACTOR, sigma * ADAPT_FACTOR)
    return jnp.clip(moved, *SIGMA_RANGE)


def perturb(actor: mlp.Network, sigma: Array, key: Array) -> mlp.Network:
    """The actor with Gaussian noise on every weight and bias."""
    keys = jax.random.split(key, (len(actor), len(NOISY)))
    return tuple(
        layer
        | {
            name: layer[name] + sigma * jax.random.normal(k, layer[name].shape)
            for name, k in zip(NOISY, layer_keys, strict=True)
        }
        for layer, layer_keys in zip(actor, keys, strict=True)
    )

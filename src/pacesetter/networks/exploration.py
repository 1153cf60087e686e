"""How a deterministic actor explores: noise on its actions, or on its own weights."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator, ValidationInfo

from pacesetter.networks import mlp
from pacesetter.networks.forward import forward
from pacesetter.networks.mlp import Array
from pacesetter.types import Floats, Layers

OU_PULL = 0.15
SPARSE_CHANCE = 0.05
ADAPT_EVERY = 50  # updates of a learner between two adaptations of its parameter noise
ADAPT_FACTOR = 1.01
SIGMA_RANGE = (1e-4, 1.0)  # where tanh saturates, distance no longer tells of sigma
NOISY = ("kernel", "bias")  # and not the gains of layer norm

Rng = np.random.Generator


def _fits_all_layers(kind: str, info: ValidationInfo) -> str:
    if kind == "parameter" and not info.data.get("actor_layer_norm"):
        raise ValueError("needs --actor-layer-norm, so that one sigma fits all layers")
    if kind == "parameter" and info.data.get("actor_observes"):
        raise ValueError("would put noise on weights that --actor-observes keeps at 0")
    return kind


Kind = Annotated[Literal["gaussian", "ou", "sparse", "parameter"], AfterValidator(_fits_all_layers)]


class Exploration(NamedTuple):
    """One way to explore.

    `params` are the actor and `state`, what this way adapts as it learns: () for most.
    `start_episode(params, size, rng)` makes the noise state of an episode, and
    `act(params, noise_state, observation, scale, rng)` an action (A,) and the next noise state.
    """

    start_episode: Callable[[Any, int, Rng], Any]
    act: Callable[[Any, Any, Floats, float, Rng], tuple[Floats, Any]]
    init: Callable[[float], Any] = lambda scale: ()
    adapts: bool = False


def _normal(shape: tuple[int, ...], scale: float, rng: Rng) -> Floats:
    return np.float32(scale) * rng.standard_normal(shape, np.float32)


def _gaussian(
    params: Any, noise_state: Any, observation: Floats, scale: float, rng: Rng
) -> tuple[Floats, Any]:
    action: Floats = np.tanh(forward(params[0], observation))
    return action + _normal(action.shape, scale, rng), noise_state


def _ou(
    params: Any, noise_state: Floats, observation: Floats, scale: float, rng: Rng
) -> tuple[Floats, Any]:
    draw = _normal(noise_state.shape, scale, rng)
    noise = np.add((1 - OU_PULL) * noise_state, draw, dtype=np.float32)
    return np.tanh(forward(params[0], observation)) + noise, noise


def _sparse(
    params: Any, noise_state: Any, observation: Floats, scale: float, rng: Rng
) -> tuple[Floats, Any]:
    before = forward(params[0], observation)
    chosen = rng.random(before.shape) < SPARSE_CHANCE
    return np.tanh(before + _normal(before.shape, scale, rng) * chosen), noise_state


def _noisy_actor(params: tuple[Layers, Any], size: int, rng: Rng) -> Layers:
    actor, sigma = params

    def noisy(value: Floats) -> Floats:
        return value + _normal(value.shape, sigma, rng)

    return tuple(
        {name: noisy(value) if name in NOISY else value for name, value in layer.items()}
        for layer in actor
    )


def _by_noisy_actor(
    params: Any, noise_state: Layers, observation: Floats, scale: float, rng: Rng
) -> tuple[Floats, Any]:
    return np.tanh(forward(noise_state, observation)), noise_state


def first_sigma(goal: float) -> Array:
    """Standard deviation of the weights' noise at the start: the goal itself."""
    return jnp.clip(jnp.asarray(goal, jnp.float32), *SIGMA_RANGE)


KINDS = {
    "gaussian": Exploration(lambda params, size, rng: (), _gaussian),
    # Ornstein-Uhlenbeck with theta 0.15 and unit time step (Lillicrap et al. 2016, section 7).
    "ou": Exploration(lambda params, size, rng: np.zeros(size, np.float32), _ou),
    # STEVE (Buckman et al. 2018): noise before the tanh, on each number with a chance of 5%.
    "sparse": Exploration(lambda params, size, rng: (), _sparse),
    # Plappert et al. 2018: one actor with noisy weights acts a whole episode, without other noise.
    "parameter": Exploration(_noisy_actor, _by_noisy_actor, first_sigma, adapts=True),
}


def adapt(learner: Any, state: Any, observation: Array, key: Array) -> tuple[Any, Array]:
    """A learner's state with sigma adapted if a multiple of 50 updates has passed, and sigma."""
    goal = learner.hyper.exploration_noise
    sigma = jax.lax.cond(
        state.updates % ADAPT_EVERY < learner.updates_per_call,
        lambda sigma: adapt_sigma(sigma, state.actor, goal, observation, key),
        lambda sigma: sigma,
        state.exploration,
    )
    return state._replace(exploration=sigma), sigma


def adapt_sigma(
    sigma: Array, actor: mlp.Network, goal: float, observation: Array, key: Array
) -> Array:
    """Move sigma by 1% so that perturbed actions lie `goal` from unperturbed ones (Plappert et al.
    2018, appendix C), on a batch of observations (B, O) and with a perturbed copy for this alone.
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

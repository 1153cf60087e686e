"""TD7's networks (Fujimoto et al. 2023): encoders, and networks that also read embeddings.

An actor or critic is a tuple of layers. The first embeds its own inputs linearly; behind it their
embedding and those of the encoder go through the rest together. Embeddings are divided by their
mean absolute number.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from pacesetter.batch import Spec
from pacesetter.networks import mlp
from pacesetter.networks.forward import ENCODER, LENGTH_EPSILON
from pacesetter.networks.mlp import Array, Network


class Encoder(NamedTuple):
    """The encoder of states, and that of a state's embedding with an action."""

    state: Network
    action: Network


def init_encoder(key: Array, spec: Spec, hidden: Sequence[int], size: int) -> Encoder:
    """New encoders, whose embeddings have `size` numbers."""
    state_key, action_key = jax.random.split(key)
    return Encoder(
        mlp.init(state_key, spec.observation_size, hidden, size),
        mlp.init(action_key, size + spec.action_size, hidden, size),
    )


def init(key: Array, inputs: int, embeddings: int, hidden: Sequence[int], outputs: int) -> Network:
    """A new actor or critic, which reads so many numbers of embeddings besides its inputs."""
    first_key, rest_key = jax.random.split(key)
    rest = mlp.init(rest_key, hidden[0] + embeddings, hidden, outputs)
    return (mlp.dense(first_key, inputs, hidden[0]), *rest)


def average_l1(x: Array) -> Array:
    """Vectors (..., n) over their mean absolute number."""
    return x / jnp.maximum(jnp.abs(x).mean(axis=-1, keepdims=True), LENGTH_EPSILON)


def zs(encoder: Encoder, observation: Array) -> Array:
    """The embedding (..., size) of a state."""
    return average_l1(mlp.apply(encoder.state, observation, jax.nn.elu))


def zsa(encoder: Encoder, zs: Array, action: Array) -> Array:
    """The embedding (..., size) of a state's embedding and an action, of any length."""
    return mlp.apply(encoder.action, jnp.concatenate([zs, action], axis=-1), jax.nn.elu)


def action(actor: Network, observation: Array, zs: Array) -> Array:
    """Deterministic action (..., A) in [-1, 1]."""
    x = jnp.concatenate([_embedded(actor, observation), zs], axis=-1)
    return jnp.tanh(mlp.apply(actor[1:], x))


def outputs(critic: Network, observation: Array, action: Array, zsa: Array, zs: Array) -> Array:
    """One critic's output (..., 1)."""
    own = _embedded(critic, jnp.concatenate([observation, action], axis=-1))
    return mlp.apply(critic[1:], jnp.concatenate([own, zsa, zs], axis=-1), jax.nn.elu)


def _embedded(network: Network, x: Array) -> Array:
    return average_l1(x @ network[0]["kernel"] + network[0]["bias"])


def with_encoder(actor: Network, encoder: Encoder) -> Network:
    """The actor as a policy file holds it: its first layer holds the state's encoder too."""
    names = zip(ENCODER, encoder.state, strict=True)
    beside = {
        name: layer[part]
        for pair, layer in names
        for name, part in zip(pair, ("kernel", "bias"), strict=True)
    }
    return (actor[0] | beside, *actor[1:])

"""Networks that batch-renormalise the input of every layer (Ioffe 2017), as CrossQ has them.

A layer is a dict: kernel, bias, the gain `scale` and `offset` of its normalised inputs, and their
running `mean` and `variance`, which no gradient reaches.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from pacesetter.networks import mlp
from pacesetter.networks.mlp import Array, Layer, Network

MOMENTUM = 0.99  # of the running statistics
EPSILON = 1e-3
MOST_STRETCH, MOST_SHIFT = 3.0, 5.0  # Ioffe's r_max and d_max


def init(key: Array, inputs: int, hidden: Sequence[int], outputs: int) -> Network:
    """A new network, whose running statistics are 0 and 1."""
    return tuple(
        layer | _norm(len(layer["kernel"])) for layer in mlp.init(key, inputs, hidden, outputs)
    )


def _norm(size: int) -> Layer:
    ones, zeros = jnp.ones(size), jnp.zeros(size)
    return {"scale": ones, "offset": zeros, "mean": zeros, "variance": ones}


def fold(network: Network) -> Network:
    """The plain network that normalises by the running statistics."""

    def plain(layer: Layer) -> Layer:
        gain = layer["scale"] / jnp.sqrt(layer["variance"] + EPSILON)
        shift = layer["offset"] - layer["mean"] * gain
        kernel = layer["kernel"]
        return {"kernel": gain[:, None] * kernel, "bias": layer["bias"] + shift @ kernel}

    return tuple(plain(layer) for layer in network)


def train(network: Network, x: Array, warm: Array) -> tuple[Array, Network]:
    """Outputs (B, outputs) as in learning, and the network with its statistics moved."""
    layers: list[Layer] = []
    for index, layer in enumerate(network):
        x, statistics = renormalize(layer, x if index == 0 else jax.nn.relu(x), warm)
        x = (x * layer["scale"] + layer["offset"]) @ layer["kernel"] + layer["bias"]
        layers.append(layer | statistics)
    return x, tuple(layers)


def renormalize(layer: Layer, x: Array, warm: Array) -> tuple[Array, Layer]:
    """x (B, inputs) normalised by its batch, then, if warm, led to what the running statistics
    would have made of it, within limits; and these statistics moved towards the batch's.
    """
    mean, variance = x.mean(axis=0), x.var(axis=0)
    deviation = jnp.sqrt(variance + EPSILON)
    running = jnp.sqrt(layer["variance"] + EPSILON)
    stretch = jnp.clip(deviation / running, 1 / MOST_STRETCH, MOST_STRETCH)
    shift = jnp.clip((mean - layer["mean"]) / running, -MOST_SHIFT, MOST_SHIFT)
    stretch, shift = jax.lax.stop_gradient((jnp.where(warm, stretch, 1), jnp.where(warm, shift, 0)))
    moved = {
        "mean": MOMENTUM * layer["mean"] + (1 - MOMENTUM) * mean,
        "variance": MOMENTUM * layer["variance"] + (1 - MOMENTUM) * variance,
    }
    return (x - mean) / deviation * stretch + shift, jax.lax.stop_gradient(moved)


def with_statistics(network: Network, trained: Network) -> Network:
    """The first network's weights with the second's running statistics."""
    return tuple(
        layer | {name: other[name] for name in ("mean", "variance")}
        for layer, other in zip(network, trained, strict=True)
    )

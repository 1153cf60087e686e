"""Networks that batch-renormalise the input of every layer (Ioffe 2017), as CrossQ has them.

A layer is a dict: kernel, bias, the gain `scale` and `offset` of its normalised inputs, and their
running `mean` and `variance`, which no gradient reaches.
"""

from collections.abc import Sequence
from typing import NamedTuple

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
        x = x if index == 0 else jax.nn.relu(x)
        norm = norm_of(layer, (x.mean(axis=0), x.var(axis=0)), warm)
        x = _outputs(layer, norm, x, is_input=index == 0)
        layers.append(layer | norm.moved)
    return x, tuple(layers)


def train_beside(network: Network, x: Array, beside: Array, warm: Array) -> tuple[Array, Network]:
    """As `train` on x (B, inputs) and as many rows beside them, but no gradient flows through the
    latter: in every layer they are constants that take part in the batch's mean and variance.

    Outputs (2 B, outputs), x's first. Gradients then cost half of what those of all rows do.
    """
    layers: list[Layer] = []
    for index, layer in enumerate(network):
        if index > 0:
            x, beside = jax.nn.relu(x), jax.nn.relu(beside)
        norm = norm_of(layer, moments_beside(x, beside), warm)
        fixed = jax.lax.stop_gradient((layer, norm, beside))
        x = _outputs(layer, norm, x, is_input=index == 0)
        beside = _outputs(*fixed, is_input=index == 0)
        layers.append(layer | norm.moved)
    return jnp.concatenate([x, beside]), tuple(layers)


def moments_beside(x: Array, beside: Array) -> tuple[Array, Array]:
    """Mean and variance (inputs,) of x (B, inputs) and as many constant rows together."""
    beside = jax.lax.stop_gradient(beside)
    mean = (x.mean(axis=0) + beside.mean(axis=0)) / 2
    squares = ((x - mean) ** 2).mean(axis=0) + ((beside - mean) ** 2).mean(axis=0)
    return mean, squares / 2


class Norm(NamedTuple):
    """What normalises a batch: (x - mean) * gain + shift. Each is (inputs,)."""

    mean: Array
    gain: Array
    shift: Array
    moved: Layer  # the running statistics after it

    def __call__(self, x: Array) -> Array:
        """Rows x (B, inputs), normalised."""
        return (x - self.mean) * self.gain + self.shift


def norm_of(layer: Layer, moments: tuple[Array, Array], warm: Array) -> Norm:
    """What normalises a batch with these moments, then, if warm, leads it to what the running
    statistics would have made of it, within limits; and moves these statistics to the batch's.
    """
    mean, variance = moments
    deviation = jnp.sqrt(variance + EPSILON)
    running = jnp.sqrt(layer["variance"] + EPSILON)
    stretch = jnp.clip(deviation / running, 1 / MOST_STRETCH, MOST_STRETCH)
    shift = jnp.clip((mean - layer["mean"]) / running, -MOST_SHIFT, MOST_SHIFT)
    stretch, shift = jax.lax.stop_gradient((jnp.where(warm, stretch, 1), jnp.where(warm, shift, 0)))
    moved = {
        "mean": MOMENTUM * layer["mean"] + (1 - MOMENTUM) * mean,
        "variance": MOMENTUM * layer["variance"] + (1 - MOMENTUM) * variance,
    }
    return Norm(mean, stretch / deviation, shift, jax.lax.stop_gradient(moved))


def _outputs(layer: Layer, norm: Norm, x: Array, is_input: bool) -> Array:
    """A layer's outputs (B, outputs) for rows x (B, inputs) that are not normalised yet.

    Hidden units are normalised by changing the kernel instead of the rows, which are more. Of the
    network's own inputs, whose mean may be many deviations from 0, that would lose digits.
    """
    if is_input:
        return (norm(x) * layer["scale"] + layer["offset"]) @ layer["kernel"] + layer["bias"]
    gain = norm.gain * layer["scale"]
    shift = norm.shift * layer["scale"] + layer["offset"] - norm.mean * gain
    return x @ (gain[:, None] * layer["kernel"]) + (shift @ layer["kernel"] + layer["bias"])


def unit_length(network: Network) -> Network:
    """The network with the weights into every hidden unit, its bias among them, at length 1.

    Batch norm behind the unit cancels their length, which only decides how far a step of Adam
    turns them. That of the head is the size of the values, which nothing behind it cancels.
    """
    return (*map(_unit_length, network[:-1]), network[-1])


def _unit_length(layer: Layer) -> Layer:
    kernel, bias = layer["kernel"], layer["bias"]
    length = jnp.sqrt((kernel**2).sum(axis=-2) + bias**2)
    return layer | {"kernel": kernel / length[..., None, :], "bias": bias / length}


def with_statistics(network: Network, trained: Network) -> Network:
    """The first network's weights with the second's running statistics."""
    return tuple(
        layer | {name: other[name] for name in ("mean", "variance")}
        for layer, other in zip(network, trained, strict=True)
    )

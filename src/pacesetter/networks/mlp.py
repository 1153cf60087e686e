"""Multi-layer perceptrons as plain pytrees: a tuple of layers, each a dict of arrays."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from pacesetter.networks.forward import NORM_EPSILON
from pacesetter.types import Layers

Array = jax.Array
Layer = dict[str, Array]
Network = tuple[Layer, ...]


def dense(key: Array, fan_in: int, fan_out: int, bound: float | None = None) -> Layer:
    """Weights and bias uniform in +-bound, by default 1/sqrt(fan_in) as PyTorch's Linear."""
    limit = fan_in**-0.5 if bound is None else bound
    kernel_key, bias_key = jax.random.split(key)
    return {
        "kernel": jax.random.uniform(kernel_key, (fan_in, fan_out), minval=-limit, maxval=limit),
        "bias": jax.random.uniform(bias_key, (fan_out,), minval=-limit, maxval=limit),
    }


def init(
    key: Array,
    inputs: int,
    hidden: Sequence[int],
    outputs: int,
    *,
    layer_norm: bool = False,
    output_bound: float | None = None,
    joins: tuple[int, int] | None = None,
) -> Network:
    """A new network; `joins=(layer, size)` widens that layer's input, for a late action."""
    sizes = [inputs, *hidden, outputs]
    extra = dict([joins] if joins else [])
    layers: list[Layer] = []
    for index, layer_key in enumerate(jax.random.split(key, len(sizes) - 1)):
        is_output = index == len(hidden)
        fan_in = sizes[index] + extra.get(index, 0)
        layer = dense(layer_key, fan_in, sizes[index + 1], output_bound if is_output else None)
        if layer_norm and not is_output:
            layer |= {"scale": jnp.ones(sizes[index + 1]), "offset": jnp.zeros(sizes[index + 1])}
        layers.append(layer)
    return tuple(layers)


def orthogonal(
    key: Array, inputs: int, hidden: Sequence[int], outputs: int, output_gain: float
) -> Network:
    """A new network for tanh units: orthogonal kernels of gain sqrt(2), no bias (Andrychowicz et
    al. 2021)."""
    sizes = [inputs, *hidden, outputs]
    gains = [2**0.5] * len(hidden) + [output_gain]
    layers: list[Layer] = []
    for index, layer_key in enumerate(jax.random.split(key, len(gains))):
        kernel = jax.nn.initializers.orthogonal(gains[index])
        shape = (sizes[index], sizes[index + 1])
        layers.append({"kernel": kernel(layer_key, shape), "bias": jnp.zeros(shape[1])})
    return tuple(layers)


def hidden_layer(layer: Layer, x: Array, activation: Callable[[Array], Array]) -> Array:
    """One hidden layer: affine, layer norm if it has one, activation."""
    x = x @ layer["kernel"] + layer["bias"]
    if "scale" in layer:
        x = standardize(x) * layer["scale"] + layer["offset"]
    return activation(x)


@jax.custom_vjp
def standardize(x: Array) -> Array:
    """Vectors (..., n) less their mean, over their standard deviation (Ba et al. 2016).

    As jax.nn.standardize; the gradient in closed form makes updates of networks with layer norm
    2 to 10% quicker.
    """
    return _standardize(x)[0]


def _standardize(x: Array) -> tuple[Array, tuple[Array, Array]]:
    centred = x - x.mean(axis=-1, keepdims=True)
    # Of the centred values, as PyTorch: E x^2 - (E x)^2 in float32 fails where the mean is large.
    scale = jax.lax.rsqrt(jnp.square(centred).mean(axis=-1, keepdims=True) + NORM_EPSILON)
    standard = centred * scale
    return standard, (standard, scale)


def _standardize_gradient(kept: tuple[Array, Array], gradient: Array) -> tuple[Array]:
    standard, scale = kept
    along = (gradient * standard).mean(axis=-1, keepdims=True)
    return (scale * (gradient - gradient.mean(axis=-1, keepdims=True) - standard * along),)


standardize.defvjp(_standardize, _standardize_gradient)


def apply(network: Network, x: Array, activation: Callable[[Array], Array] = jax.nn.relu) -> Array:
    """The network's linear output (..., outputs) for inputs (..., inputs)."""
    for layer in network[:-1]:
        x = hidden_layer(layer, x, activation)
    return x @ network[-1]["kernel"] + network[-1]["bias"]


def actor(network: Network, observation: Array) -> Array:
    """Deterministic action (..., A) in [-1, 1]."""
    return jnp.tanh(apply(network, observation))


def outputs(network: Network, observation: Array, action: Array, action_layer: int = 0) -> Array:
    """A critic's outputs (..., outputs) for an action, which joins at `action_layer`."""
    x = observation
    for layer in network[:action_layer]:
        x = hidden_layer(layer, x, jax.nn.relu)
    return apply(network[action_layer:], jnp.concatenate([x, action], axis=-1))


def each(one: Callable[..., Any], networks: Network, *inputs: Array) -> Any:
    """`one(network, *inputs)` of N networks, whose leaves carry a leading axis of N.

    Each gets inputs of its own: from shared ones XLA makes one wide product whose result it then
    has to transpose, which costs 5% of an update.
    """
    count = networks[0]["kernel"].shape[0]
    own = jax.lax.optimization_barrier([jnp.stack([x] * count) for x in inputs])
    return jax.vmap(one)(networks, *own)


def adam(learning_rate: float, decay: float = 0.0) -> optax.GradientTransformation:
    """Adam; with `decay`, weights times it are added to the gradient (L2)."""
    decayed = [optax.add_decayed_weights(decay)] if decay else []
    return optax.chain(*decayed, optax.adam(learning_rate))


def apply_gradient(
    optimizer: optax.GradientTransformation, params: Any, gradient: Any, opt_state: Any
) -> tuple[Any, Any]:
    """One optimiser step: the new parameters and optimiser state."""
    change, opt_state = optimizer.update(gradient, opt_state, params)
    return optax.apply_updates(params, change), opt_state


def blinded(network: Network, seen: Array) -> Network:
    """The network with weights of 0 on the inputs that are not `seen` (inputs,)."""
    first, *others = network
    return ({**first, "kernel": jnp.where(seen[:, None], first["kernel"], 0)}, *others)


def replaced(network: Network, layers: Layers) -> Network:
    """The network with other layers of the same shapes; a ValueError says what does not fit."""
    shapes = [
        [{name: np.shape(value) for name, value in layer.items()} for layer in each]
        for each in (network, layers)
    ]
    if shapes[0] != shapes[1]:
        raise ValueError(f"its layers have shapes {shapes[1]}, this run's {shapes[0]}")
    leaves = [jnp.array(leaf) for leaf in jax.tree.leaves(list(layers))]
    return jax.tree.unflatten(jax.tree.structure(network), leaves)

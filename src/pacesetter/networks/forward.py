"""Networks in NumPy alone, for acting in training and from a policy file: twin of mlp and sale."""

from collections.abc import Callable

import numpy as np

from pacesetter.types import Floats, Layers

ENCODER = [(f"encoder_kernel_{i}", f"encoder_bias_{i}") for i in (1, 2, 3)]
NORM_EPSILON = 1e-5
LENGTH_EPSILON = np.float32(1e-8)


def relu(x: Floats) -> Floats:
    return np.maximum(x, np.float32(0))


def clip(x: Floats, low: float = -1.0, high: float = 1.0) -> Floats:
    """Clip to a range; faster than np.clip for the few numbers of an action."""
    return np.minimum(np.maximum(x, np.float32(low)), np.float32(high))


def elu(x: Floats) -> Floats:
    return np.maximum(x, np.expm1(np.minimum(x, np.float32(0))))


def average_l1(x: Floats) -> Floats:
    """Vectors (..., n) over their mean absolute number (TD7)."""
    return x / np.maximum(np.abs(x).mean(axis=-1, keepdims=True), LENGTH_EPSILON)


ACTIVATIONS: dict[str, Callable[[Floats], Floats]] = {"relu": relu, "tanh": np.tanh}
OUTPUTS: dict[str, Callable[[Floats], Floats]] = {"tanh": np.tanh, "clip": clip}


def forward(layers: Layers, x: Floats, activation: Callable[[Floats], Floats] = relu) -> Floats:
    """The linear output (..., outputs) of one network, as `mlp.apply` gives it in JAX."""
    for layer in layers[:-1]:
        if has_encoder(layer):
            x = embed(layer, x)
            continue
        x = x @ layer["kernel"] + layer["bias"]
        if "scale" in layer:
            centred = x - x.mean(axis=-1, keepdims=True)
            variance = (centred**2).mean(axis=-1, keepdims=True)
            x = centred / np.sqrt(variance + NORM_EPSILON) * layer["scale"] + layer["offset"]
        x = activation(x)
    return x @ layers[-1]["kernel"] + layers[-1]["bias"]


def has_encoder(layer: dict[str, Floats]) -> bool:
    """Whether a layer is TD7's first stage."""
    return ENCODER[0][0] in layer


def embed(layer: dict[str, Floats], x: Floats) -> Floats:
    """TD7's first stage: a linear embedding of x beside what the state encoder makes of x."""
    encoded = x
    for kernel, bias in ENCODER[:-1]:
        encoded = elu(encoded @ layer[kernel] + layer[bias])
    kernel, bias = ENCODER[-1]
    parts = (x @ layer["kernel"] + layer["bias"], encoded @ layer[kernel] + layer[bias])
    return np.concatenate([average_l1(part) for part in parts], axis=-1)

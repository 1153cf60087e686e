"""A policy as an ONNX model that needs none of this package."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pacesetter.errors import UsageError, writing
from pacesetter.extras import need
from pacesetter.files import write_atomically
from pacesetter.networks.forward import (
    ACTIVATIONS,
    ENCODER,
    LENGTH_EPSILON,
    NORM_EPSILON,
    OUTPUTS,
    forward,
    has_encoder,
)
from pacesetter.policy import OBSERVATION_LIMIT, Floats, Layers, Policy, to_env

INSTALL = "pacesetter[onnx]"
OPSET, IR = 17, 8  # of 2022: runtimes from onnxruntime 1.12 on read them
OPERATORS = {"relu": "Relu", "tanh": "Tanh"}  # of forward.ACTIVATIONS and, but for clip, OUTPUTS
TOLERANCE = 1e-6  # of the action range
Array = NDArray[Any]


class Checked(NamedTuple):
    """Differences from the NumPy policy, as shares of the action range."""

    exact: float  # the largest, both computed in float64
    rounded: float  # on average, both in float32


def to_onnx(policy: Policy, path: Path) -> Checked:
    """Write observations (batch, O) -> actions (batch, A) in the env's units, once it is checked.

    Normalisation, the mean over actors and the action's bounds are in the graph. Needs the extra
    `onnx`; a model that differs from the NumPy policy raises a UsageError and is not written.
    """
    if path.suffix != ".onnx":
        raise UsageError(f"onnx: {path} must end in .onnx")
    model = build(policy)
    found = check(policy, model, build(policy, np.float64))
    with writing("onnx", path):
        write_atomically(path, model)
    return found


class Graph:
    """Nodes and constants of a graph that is being written down, all of one number type."""

    def __init__(self, dtype: Any) -> None:
        self.helper = need("onnx", "onnx", INSTALL).helper
        self.arrays = need("onnx", "onnx.numpy_helper", INSTALL)
        self.dtype, self.nodes, self.constants = dtype, list[Any](), list[Any]()

    def constant(self, value: Any) -> str:
        """The name of a constant."""
        name = f"c{len(self.constants)}"
        self.constants.append(self.arrays.from_array(np.asarray(value, self.dtype), name))
        return name

    def node(self, operator: str, *inputs: str | Any, **attributes: Any) -> str:
        """The name of what an operator gives; inputs that are no names become constants."""
        names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        name = f"x{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(operator, names, [name], **attributes))
        return name


def build(policy: Policy, dtype: Any = np.float32) -> bytes:
    """The serialised model; float64 is for checking its arithmetic."""
    onnx, graph = need("onnx", "onnx", INSTALL), Graph(dtype)
    helper, kind = graph.helper, graph.helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    inputs, outputs = policy.observation_size, len(policy.low)
    actions = [_actor(graph, policy, layers, _input(graph, policy)) for layers in policy.actors]
    share = _bounds(graph, policy, _mean(graph, actions))
    graph.nodes.append(helper.make_node("Identity", [share], ["action"]))
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "policy",
            [helper.make_tensor_value_info("observation", kind, ["batch", inputs])],
            [helper.make_tensor_value_info("action", kind, ["batch", outputs])],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR,
        producer_name="pacesetter",
    )
    helper.set_model_props(model, about(policy))
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def about(policy: Policy) -> dict[str, str]:
    """The model's metadata: all that the policy file says, and its bounds; tables as JSON."""
    table = {**policy.about, "low": policy.low.tolist(), "high": policy.high.tolist()}
    return {
        key: value if isinstance(value, str) else json.dumps(value) for key, value in table.items()
    }


def _input(graph: Graph, policy: Policy) -> str:
    if policy.normalizer is None:
        return "observation"
    mean, deviation = policy.normalizer
    scaled = graph.node("Div", graph.node("Sub", "observation", mean), deviation)
    return graph.node("Clip", scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def _actor(graph: Graph, policy: Policy, layers: Layers, x: str) -> str:
    for layer in layers[:-1]:
        if has_encoder(layer):
            x = _embed(graph, x, layer)
            continue
        x = graph.node("Gemm", x, layer["kernel"], layer["bias"])
        if "scale" in layer:
            x = _layer_norm(graph, x, layer["scale"], layer["offset"])
        x = graph.node(OPERATORS[policy.activation], x)
    x = graph.node("Gemm", x, layers[-1]["kernel"], layers[-1]["bias"])
    if policy.output == "clip":
        return graph.node("Clip", x, -1, 1)
    return graph.node(OPERATORS[policy.output], x)


def _embed(graph: Graph, x: str, layer: dict[str, Array]) -> str:
    """What `forward.embed` does."""
    encoded = x
    for kernel, bias in ENCODER[:-1]:
        encoded = _elu(graph, graph.node("Gemm", encoded, layer[kernel], layer[bias]))
    kernel, bias = ENCODER[-1]
    parts = [
        graph.node("Gemm", x, layer["kernel"], layer["bias"]),
        graph.node("Gemm", encoded, layer[kernel], layer[bias]),
    ]
    return graph.node("Concat", *(_average_l1(graph, part) for part in parts), axis=-1)


def _elu(graph: Graph, x: str) -> str:
    """In single operators, since onnxruntime's own knows no float64."""
    below = graph.node("Sub", graph.node("Exp", graph.node("Min", x, 0)), 1)
    return graph.node("Max", x, below)


def _average_l1(graph: Graph, x: str) -> str:
    size = graph.node("ReduceMean", graph.node("Abs", x), axes=[-1])
    return graph.node("Div", x, graph.node("Max", size, LENGTH_EPSILON))


def _layer_norm(graph: Graph, x: str, scale: Array, offset: Array) -> str:
    """In single operators, since ONNX's own always averages in float32; runtimes fuse them."""
    centred = graph.node("Sub", x, graph.node("ReduceMean", x, axes=[-1]))
    variance = graph.node("ReduceMean", graph.node("Mul", centred, centred), axes=[-1])
    deviation = graph.node("Sqrt", graph.node("Add", variance, NORM_EPSILON))
    return graph.node(
        "Add", graph.node("Mul", graph.node("Div", centred, deviation), scale), offset
    )


def _mean(graph: Graph, actions: list[str]) -> str:
    if len(actions) == 1:
        return actions[0]
    return graph.node("Div", graph.node("Sum", *actions), float(len(actions)))


def _bounds(graph: Graph, policy: Policy, action: str) -> str:
    """What `policy.to_env` does."""
    share = graph.node("Div", graph.node("Add", graph.node("Clip", action, -1, 1), 1), 2)
    below = graph.node("Mul", graph.node("Sub", 1, share), policy.low)
    scaled = graph.node("Add", below, graph.node("Mul", share, policy.high))
    return graph.node("Min", graph.node("Max", scaled, policy.low), policy.high)


def check(policy: Policy, model: bytes, twin: bytes) -> Checked:
    """Run the model and its float64 twin beside NumPy on random and extreme observations.

    Two programs differ in float32, since they take sums in another order. So the arithmetic is
    compared in float64, to 1e-6 of the action range; in float32, random ones on average.
    """
    span = np.maximum(policy.high - policy.low, np.finfo(np.float32).tiny)
    random, extreme = observations(policy)
    every = np.concatenate([random, extreme])
    given = _run(twin, every.astype(np.float64))
    exact = float(np.max(np.abs(given - in_float64(policy, every)) / span))
    given = _run(model, every)
    wanted = to_env(policy.act(random), policy.low, policy.high)
    rounded = float(np.mean(np.abs(given[: len(random)] - wanted) / span))
    inside = (given >= policy.low) & (given <= policy.high)
    if not (max(exact, rounded) <= TOLERANCE and inside.all()):
        raise UsageError(
            f"onnx: onnxruntime differs from the policy by {exact:.1e} of the action range in "
            f"float64, by {rounded:.1e} on average in float32; nothing is written"
        )
    return Checked(exact, rounded)


def observations(policy: Policy) -> tuple[Floats, Floats]:
    """Ordinary ones, in the units of the normaliser, and ones from zero to far beyond any task."""
    size, rng = policy.observation_size, np.random.default_rng(0)
    mean, deviation = policy.normalizer or (np.zeros(size), np.ones(size))
    random = mean + deviation * rng.normal(size=(252, size))
    corners = [rng.choice([-1.0, 0.0, 1.0], (21, size)) * scale for scale in (1.0, 1e2, 1e4, 1e6)]
    extreme = np.concatenate([np.zeros((1, size)), *corners])
    return random.astype(np.float32), extreme.astype(np.float32)


def in_float64(policy: Policy, observation: Floats) -> Array:
    """What the policy computes, in float64: actions (..., A) in the env's units."""
    x: Any = observation.astype(np.float64)
    if policy.normalizer is not None:
        mean, deviation = policy.normalizer
        x = np.clip((x - mean) / deviation, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
    output, activation = OUTPUTS[policy.output], ACTIVATIONS[policy.activation]
    actions = [output(forward(_wide(layers), x, activation)) for layers in policy.actors]
    low, high = _wide([{"low": policy.low, "high": policy.high}])[0].values()
    return to_env(np.asarray(np.mean(actions, axis=0)), low, high)


def _wide(layers: Layers) -> Any:
    return [{name: array.astype(np.float64) for name, array in layer.items()} for layer in layers]


def _run(model: bytes, observations: Array) -> Array:
    """Actions of onnxruntime, which is given batches of 7, a shorter one, and batches of 1."""
    library = need("onnx", "onnxruntime", INSTALL)
    options = library.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 1
    session = library.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    alone = len(observations) // 10
    batches = [observations[n : n + 1] for n in range(alone)]
    batches += [observations[n : n + 7] for n in range(alone, len(observations), 7)]
    return np.concatenate([session.run(None, {"observation": batch})[0] for batch in batches])

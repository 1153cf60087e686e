"""A trained policy: one small file, and its actions in NumPy without JAX or training code."""

import math
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pacesetter import storage
from pacesetter.errors import UsageError, unknown
from pacesetter.networks.forward import ACTIVATIONS, ENCODER, OUTPUTS, clip, forward, has_encoder
from pacesetter.text import check_id
from pacesetter.types import Floats, Layers, Shape

KIND = "policy"
SUFFIX = ".safetensors"
FILE = f"policy{SUFFIX}"  # in a run's folder, and on the hub
CHAMPION = "champion:"
SCHEMA = 1
LAYERS = (
    {"kernel", "bias"},
    {"kernel", "bias", "scale", "offset"},
    {"kernel", "bias", *(name for pair in ENCODER for name in pair)},
)
OBSERVATION_LIMIT = 10.0


class Actors(NamedTuple):
    """An algorithm's part of a policy file: layers with a leading axis N of averaged actors."""

    layers: Any
    activation: str
    output: str


def to_env(action: Floats, low: Floats, high: Floats) -> Floats:
    """Clip an action to [-1, 1] and scale it to the env's own bounds; done nowhere else."""
    share = (clip(action) + np.float32(1)) / np.float32(2)
    scaled = low * (np.float32(1) - share) + high * share
    return np.minimum(np.maximum(scaled, low), high)


def normalize(observation: Floats, mean: Floats, deviation: Floats) -> Floats:
    """Subtract the mean, divide by the standard deviation and clip at +-10, as in training."""
    scaled = (observation - mean) / deviation
    return np.clip(scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT).astype(np.float32)


@dataclass(frozen=True)
class Policy:
    """Maps an observation (O,) or a batch (B, O) to actions in the env's own units.

    `about` says where it comes from: env, env_kwargs, algorithm, step, score, versions.
    """

    actors: list[Layers]
    activation: str
    output: str
    low: Floats
    high: Floats
    normalizer: tuple[Floats, Floats] | None = None
    about: dict[str, Any] = field(default_factory=dict)
    shapes: tuple[Shape, Shape] | None = None  # the env's own, of observations and actions

    @property
    def observation_size(self) -> int:
        """Numbers of a flat observation."""
        return self.actors[0][0]["kernel"].shape[0]

    @property
    def sizes(self) -> list[int]:
        """Of an actor: the observation, each hidden layer, the action."""
        return [self.observation_size, *(layer["kernel"].shape[1] for layer in self.actors[0])]

    def __repr__(self) -> str:
        about = [str(self.about[key]) for key in ("env", "algorithm") if key in self.about]
        about += [f"step {self.about['step']:,}"] if "step" in self.about else []
        several = [f"mean of {len(self.actors)} actors"] if len(self.actors) > 1 else []
        return f"Policy({', '.join([*about, *several, ' -> '.join(map(str, self.sizes))])})"

    def __call__(self, observation: Any) -> Floats:
        """Action in the env's units and shape, clipped to its bounds."""
        x = np.asarray(observation, np.float32)
        taken, given = self.shapes or ((self.observation_size,), self.low.shape)
        batch = x.shape[: x.ndim - len(taken)]
        if x.shape != (*batch, *taken):
            wanted = ", ".join(["...", *map(str, taken)])
            raise UsageError(f"observation: shape {x.shape} given; this policy takes ({wanted})")
        action = self.act(x.reshape(*batch, math.prod(taken)))
        return to_env(action, self.low, self.high).reshape(*batch, *given)

    def act(self, observation: Any) -> Floats:
        """Action (..., A) in [-1, 1] for flat observations (..., O), the mean over the actors."""
        x = np.asarray(observation, np.float32)
        size = self.observation_size
        if x.shape[-1:] != (size,):
            raise UsageError(f"observation: shape {x.shape} given; this policy takes (..., {size})")
        if self.normalizer is not None:
            x = normalize(x, *self.normalizer)
        output, activation = OUTPUTS[self.output], ACTIVATIONS[self.activation]
        actions = [output(forward(layers, x, activation)) for layers in self.actors]
        return actions[0] if len(actions) == 1 else np.asarray(np.mean(actions, axis=0))

    def save(self, path: str | Path) -> None:
        """Write the policy file; it holds all that acting needs."""
        arrays = {
            f"actors.{n}.{i}.{name}": array
            for n, layers in enumerate(self.actors)
            for i, layer in enumerate(layers)
            for name, array in layer.items()
        }
        arrays |= {"low": self.low, "high": self.high}
        if self.normalizer is not None:
            arrays |= {"mean": self.normalizer[0], "deviation": self.normalizer[1]}
        table = {"schema": SCHEMA, "activation": self.activation, "output": self.output}
        table |= {"shapes": self.shapes, "about": self.about}
        storage.write(Path(path), KIND, storage.Content(arrays, table))


def unstack(stacked: Any) -> list[Layers]:
    """Plain NumPy layers of each of N actors, copied out of the `layers` of `Actors`."""
    count = np.asarray(stacked[0]["kernel"]).shape[0]
    return [
        [
            {name: np.array(value[n], np.float32) for name, value in layer.items()}
            for layer in stacked
        ]
        for n in range(count)
    ]


def champions() -> dict[str, Path]:
    """Shipped policies by name: inside an installed package, beside `src` in a checkout."""
    inside = Path(str(files("pacesetter"))) / "champions"
    folder = inside if inside.is_dir() else Path(__file__).parents[2] / "champions"
    return {file.stem: file for file in sorted(folder.glob("*.safetensors"))}


def file_of(name: str | Path) -> Path | None:
    """The policy file that a name means, its path or `champion:NAME`; None if it means none."""
    word = str(name)
    if not word.startswith(CHAMPION):
        return Path(name) if Path(name).suffix == SUFFIX else None
    known, short = champions(), word.removeprefix(CHAMPION)
    if short not in known:
        raise unknown("champion", short, known, "pacesetter list champions")
    return known[short]


def load(path: str | Path) -> Policy:
    """The policy of a file, of a run's folder, or `champion:NAME`; nothing in it is executed."""
    path = file_of(path) or Path(path)
    # A person, or the hub's cache, may name a link; of a run's folder the file is its own.
    path = path.resolve() if path.is_symlink() else path
    path = path / FILE if path.is_dir() else path
    arrays, table = storage.read(path, KIND)
    if table.get("schema") != SCHEMA:
        raise UsageError(
            f"{path}: policy schema {table.get('schema')}; this version reads {SCHEMA}; "
            "use the version of pacesetter that wrote it"
        )
    try:
        policy = Policy(
            actors=_actors(arrays),
            activation=_one_of(table["activation"], ACTIVATIONS),
            output=_one_of(table["output"], OUTPUTS),
            low=arrays["low"],
            high=arrays["high"],
            normalizer=(arrays["mean"], arrays["deviation"]) if "mean" in arrays else None,
            about=table["about"],
            shapes=_shapes(table.get("shapes")),
        )
        _check(policy, arrays)
    except storage.FAULTS as error:
        raise UsageError(f"{path}: damaged policy: {error}") from None
    return policy


def _check(policy: Policy, arrays: storage.Arrays) -> None:
    """Refuse values that are not finite and shapes that do not fit each other."""
    about: Any = policy.about
    if not isinstance(about, dict):
        raise ValueError("about must be a table")
    kinds = {"env": str, "algorithm": str, "name": str, "env_kwargs": dict, "step": int}
    kinds |= {"wrap": list}
    for name, kind in kinds.items():
        if not isinstance(about.get(name, kind()), kind):
            raise ValueError(f"{name} must be a {kind.__name__}")
    if not all(isinstance(wrapper, str) for wrapper in about.get("wrap", [])):
        raise ValueError("wrap must be a list of names")
    for name in about.keys() & {"env", "algorithm", "name"}:
        check_id(about[name])
    for name, array in arrays.items():
        if array.dtype != np.float32 or array.size == 0 or not np.isfinite(array).all():
            raise ValueError(f"{name} must hold finite float32 numbers")
    inputs = policy.observation_size
    for layers in policy.actors:
        outputs = _check_layers(layers, inputs)
        if policy.low.shape != (outputs,) or policy.high.shape != (outputs,):
            raise ValueError("its last layer does not fit its bounds")
    sizes = [math.prod(shape) for shape in policy.shapes or ((inputs,), policy.low.shape)]
    if sizes != [inputs, len(policy.low)]:
        raise ValueError(f"shapes of {sizes} numbers do not fit its networks")
    if not (policy.low <= policy.high).all():
        raise ValueError("a lower bound exceeds its upper bound")
    if policy.normalizer is not None:
        mean, deviation = policy.normalizer
        if mean.shape != (inputs,) or deviation.shape != (inputs,) or not (deviation > 0).all():
            raise ValueError("its normalization does not fit its networks")


def _check_layers(layers: Layers, size: int) -> int:
    """Refuse layers that do not fit each other or an input of a size; the size of the output."""
    for layer in layers:
        if layer.keys() not in LAYERS:
            raise ValueError(f"a layer has {', '.join(sorted(layer))}")
        size = _outputs(layer, size)
    return size


def _outputs(layer: dict[str, Floats], size: int) -> int:
    """How many numbers a layer makes of `size`."""
    encoded = size
    for kernel, bias in ENCODER if has_encoder(layer) else ():
        encoded = _outputs({"kernel": layer[kernel], "bias": layer[bias]}, encoded)
    shape = layer["kernel"].shape
    if len(shape) != 2 or shape[0] != size:
        raise ValueError(f"a layer of shape {shape} follows one of {size} numbers")
    beside = [layer[name] for name in ("bias", "scale", "offset") if name in layer]
    if any(x.shape != shape[1:] for x in beside):
        raise ValueError("a layer's bias or norm does not fit it")
    return shape[1] + (encoded if has_encoder(layer) else 0)


def _shapes(table: Any) -> tuple[Shape, Shape] | None:
    if table is None:  # files made before there were shapes: both flat
        return None
    observation, action = (tuple(int(size) for size in shape) for shape in table)
    return observation, action


def _one_of(word: str, options: Any) -> str:
    if word not in options:
        raise ValueError(f"'{word}' is none of {', '.join(options)}")
    return word


def _actors(arrays: storage.Arrays) -> list[Layers]:
    actors: dict[int, dict[int, dict[str, Floats]]] = {}
    for key, array in arrays.items():
        if key.startswith("actors."):
            _, n, i, name = key.split(".")
            actors.setdefault(int(n), {}).setdefault(int(i), {})[name] = array
    return [[actors[n][i] for i in range(len(actors[n]))] for n in range(len(actors))]

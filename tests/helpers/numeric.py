"""What tests of learners share: random transitions and states, and derivatives by differences."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from pacesetter.batch import Batch, Spec

KEY = jax.random.key(3)
SPEC = Spec(observation_size=3, action_size=2)


def random_batch(rng: np.random.Generator, spec: Spec, *shape: int) -> Batch:
    """Random transitions in float64, some of them terminal, with uneven weights."""

    def normal(*more: int) -> Any:
        return rng.normal(size=(*shape, *more))

    batch = Batch(
        observation=normal(spec.observation_size),
        action=np.clip(normal(spec.action_size), -1, 1),
        reward=normal(),
        next_observation=normal(spec.observation_size),
        discount=rng.choice([0, 0.99], size=shape, p=[0.2, 0.8]),
        last=None,
        weight=rng.uniform(0.5, 1.5, size=shape),
        mask=np.zeros((*shape, 0)),
    )
    return batch._replace(last=1.0 * (batch.discount == 0))


def random_state(algorithm: Any, rng: np.random.Generator, *networks: str) -> Any:
    """A new state in float64 whose networks are random, so that targets are unlike them."""
    state = jax.device_get(jax.jit(algorithm.init)(KEY))
    state = double(state)

    def draw(path: Any, x: Any) -> Any:
        noise = rng.normal(size=x.shape, scale=0.5)
        return np.abs(noise) + 0.5 if path[-1].key in ("scale", "variance") else noise

    drawn = {n: jax.tree_util.tree_map_with_path(draw, getattr(state, n)) for n in networks}
    return state._replace(**drawn)


def single(tree: Any) -> Any:
    """All numbers with a fraction as float32, which training uses."""
    return _cast(tree, np.float32)


def double(tree: Any) -> Any:
    """The same as float64."""
    return _cast(tree, np.float64)


def _cast(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, tree)


def same(one: Any, other: Any) -> bool:
    """All leaves equal bit for bit."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def all_differ(one: Any, other: Any) -> bool:
    """Every leaf differs somewhere."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(not np.array_equal(a, b) for a, b in pairs)


def member(tree: Any, index: int) -> Any:
    """One of several stacked networks."""
    return jax.tree.map(lambda x: x[index], tree)


def slopes(loss: Callable[[Any], float], network: Any, step: float = 3e-6) -> Any:
    """The gradient of a NumPy loss by central differences."""
    found = jax.tree.map(np.zeros_like, network)
    for layer, slope in zip(network, found, strict=True):
        for name, array in layer.items():
            for index in np.ndindex(array.shape):
                kept = array[index]
                array[index] = kept + step
                above = loss(network)
                array[index] = kept - step
                slope[name][index] = (above - loss(network)) / (2 * step)
                array[index] = kept
    return found


def close(found: Any, expected: Any, rtol: float = 1e-6, atol: float = 1e-8) -> None:
    """Two trees of arrays agree."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)

    def check(one: Any, other: Any) -> None:
        np.testing.assert_allclose(one, other, rtol=rtol, atol=atol)

    jax.tree.map(check, found, expected)


def near(found: Any, expected: Any) -> None:
    """What was learned is within a tenth of what is right, everywhere."""
    np.testing.assert_allclose(found, np.broadcast_to(expected, np.shape(found)), atol=0.1, rtol=0)


def says(network: Any, outputs: Any) -> Any:
    """Critics that say the same of everything: `outputs` (critics, M)."""
    *hidden, last = jax.tree.map(np.zeros_like, network)
    return (*hidden, last | {"bias": np.asarray(outputs, last["bias"].dtype)})


def perceptron(network: Sequence[dict[str, Any]], x: Any) -> Any:
    """A network's outputs in NumPy, with layer norm where it has gains."""
    for layer in network[:-1]:
        x = x @ layer["kernel"] + layer["bias"]
        if "scale" in layer:
            root = np.sqrt(x.var(axis=-1, keepdims=True) + 1e-5)
            x = (x - x.mean(axis=-1, keepdims=True)) / root * layer["scale"] + layer["offset"]
        x = np.maximum(x, 0)
    return x @ network[-1]["kernel"] + network[-1]["bias"]


def quantile_loss(outputs: Any, targets: Any) -> float:
    """Quantile Huber loss of one row with kappa 1, number by number."""
    total = 0.0
    for i, output in enumerate(outputs):
        share = (i + 0.5) / len(outputs)
        for target in targets:
            error = target - output
            huber = error**2 / 2 if abs(error) < 1 else abs(error) - 0.5
            total += (share if error >= 0 else 1 - share) * huber / len(targets)
    return total


def squashed(said: Any, noise: Any) -> tuple[Any, Any]:
    """Actions and log-probabilities of a tanh Gaussian in NumPy, by log cosh."""
    mean, log_std = np.split(said, 2, axis=-1)
    log_std = np.clip(log_std, -20, 2)
    before = mean + np.exp(log_std) * noise
    action = np.tanh(before)
    gaussian = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi)
    cosh = np.logaddexp(before, -before) - np.log(2)
    return action, (gaussian + 2 * cosh).sum(axis=-1)

"""Products in bfloat16: which are, that they round as they should, and that nothing else does."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pacesetter import Trainer, algorithms
from pacesetter.batch import Batch, Spec
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.learner.precision import bfloat16_products
from pacesetter.networks import mlp

RNG = np.random.default_rng(0)
LARGE = [RNG.standard_normal((64, 64)).astype(np.float32) for _ in range(2)]


def rounded(x: Any) -> Any:
    """To the nearest of 8 significant bits, ties to even, by the bits of float32 themselves."""
    bits = np.asarray(x, np.float32).view(np.uint32).astype(np.uint64)
    bits = (bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000
    return bits.astype(np.uint32).view(np.float32)


def product(x: Any, y: Any) -> Any:
    """The product of rounded matrices with sums in float64."""
    return rounded(x).astype(np.float64) @ rounded(y).astype(np.float64)


def close(found: Any, expected: Any) -> bool:
    """Equal but for float32 sums of 64 terms; rounding operands moves results a hundred times as
    far."""
    return bool(np.abs(np.asarray(found) - expected).max() < 2e-5)


def test_a_large_product_rounds_its_operands_and_nothing_else() -> None:
    a, b = LARGE
    found = bfloat16_products(jnp.matmul)(a, b)
    assert found.dtype == jnp.float32
    assert close(found, product(a, b))
    assert not close(jnp.matmul(a, b), product(a, b))


def test_both_products_of_a_gradient_round() -> None:
    a, b = LARGE
    gradient = bfloat16_products(jax.grad(lambda a, b: ((a @ b) ** 2).sum() / 64, argnums=(0, 1)))
    error = 2 / 64 * product(a, b).astype(np.float32)
    left, right = gradient(a, b)
    assert close(left, product(error, b.T))
    assert close(right, product(a.T, error))


def test_products_inside_loops_branches_and_rules_of_their_own() -> None:
    """A scan, a while, a cond, a vmap, and a ReLU and a layer norm, which have rules."""
    a, b = LARGE

    def function(a: Any, b: Any) -> Any:
        total, _ = jax.lax.scan(lambda sum, x: (sum + x @ b, None), jnp.zeros_like(a), a[None])
        again = jax.lax.while_loop(lambda s: s[0] < 1, lambda s: (s[0] + 1, s[1] @ b), (0, a))[1]
        chosen = jax.lax.cond(a[0, 0] < 9, lambda: a @ b, lambda: a)
        stacked = jax.vmap(jnp.matmul)(jnp.stack([a, a]), jnp.stack([b, b]))
        rules = jax.nn.relu(a @ b), mlp.standardize(a @ b)
        return total, again, chosen, stacked[1], *rules

    *found, positive, standard = jax.jit(bfloat16_products(function))(a, b)
    assert all(close(each, product(a, b)) for each in found)
    assert close(positive, np.maximum(product(a, b), 0))
    assert close(standard, jax.nn.standardize(product(a, b)))


def test_products_inside_recomputed_parts_and_solvers() -> None:
    """jax.checkpoint holds an open program, and a linear solve a named tuple of them."""
    a, b = LARGE

    def function(a: Any) -> Any:
        return jax.checkpoint(lambda x: jnp.tanh(x @ b))(a).sum()

    found = bfloat16_products(jax.checkpoint(lambda x: x @ b))(a)
    assert close(found, product(a, b))
    gradient = bfloat16_products(jax.grad(function))(a)
    assert close(gradient, product(1 - np.tanh(product(a, b)) ** 2, b.T))
    eye = np.eye(64, dtype=np.float32)
    assert close(bfloat16_products(jnp.linalg.solve)(eye, b), b)


def test_small_products_and_other_operations_stay_as_they_are() -> None:
    a, b = LARGE

    def function(a: Any, b: Any) -> Any:
        narrow = a[:, :63] @ b[:63], a @ b[:, :63], a[:63] @ b, a[0] @ b, a.ravel() @ b.ravel()
        return {"narrow": narrow, "other": jnp.sin(a) * b.sum()}, a.astype(
            jnp.int32
        ) @ jnp.ones_like(b, jnp.int32)

    found, expected = (jax.jit(f)(a, b) for f in (bfloat16_products(function), function))
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def moments(state: Any) -> list[Any]:
    """Adam's first moments of all that a learner fits."""
    adams = jax.tree.leaves(state, is_leaf=lambda x: hasattr(x, "mu"))
    return [leaf for adam in adams if hasattr(adam, "mu") for leaf in jax.tree.leaves(adam.mu)]


@pytest.mark.parametrize("name", ["td3", "sac"])
def test_an_update_differs_by_rounding_alone(name: str) -> None:
    """Every parameter stays float32 and goes nearly the same way, but not quite.

    Gradients, of which Adam's first moments are a tenth, may turn by a tenth of their length, 6
    degrees: a rounded operand is off by 1/512 and flips some ReLUs, which made 7% at most of what
    was measured with three seeds.
    """
    algorithm = algorithms.find(name).build(Spec(17, 6), resolve(name, "HalfCheetah-v5").hyper)
    shapes = {"observation": (17,), "action": (6,), "next_observation": (17,)}
    rows = (algorithm.updates_per_call, 64)
    fields = {f: RNG.normal(size=(*rows, *shapes.get(f, ()))) for f in Batch._fields}
    batch = Batch(**jax.tree.map(jnp.float32, fields))
    state, key = algorithm.init(jax.random.key(0)), jax.random.key(1)
    exact = jax.jit(algorithm.update)(state, batch, key)
    low = jax.jit(bfloat16_products(algorithm.update))(state, batch, key)
    for x, y in zip(jax.tree.leaves(exact.state), jax.tree.leaves(low.state), strict=True):
        assert x.dtype == y.dtype
    pairs = list(zip(moments(exact.state), moments(low.state), strict=True))
    assert len(pairs) >= 12  # a kernel and a bias in each layer of actor and critics
    for x, y in pairs:
        assert np.linalg.norm(x - y) < 0.1 * np.linalg.norm(x)
    losses, others = (
        np.array([update.losses[name] for name in sorted(update.losses)]) for update in (exact, low)
    )
    np.testing.assert_allclose(losses, others, rtol=0.01, atol=0.01)
    assert (losses != others).any()


def test_a_run_asks_for_it_by_name(tmp_path: Path) -> None:
    """Two runs that differ in nothing else part ways once they learn."""
    actors: list[Any] = []
    for precision in ("f32", "bf16"):
        trainer = Trainer(
            "td3", "Hopper-v5", runs=tmp_path, name=precision, precision=precision,
            steps=120, warmup=100, batch_size=64, hidden=(64, 64), eval_episodes=1,
        )  # fmt: skip
        list(trainer)
        actors.append(jax.tree.map(np.asarray, trainer.loop.learners.states[0].actor))
    apart = jax.tree.map(lambda x, y: np.abs(x - y).max(), *actors)
    assert 0 < max(jax.tree.leaves(apart)) < 0.02  # 20 Adam steps of 3e-4, opposed: 0.012


def test_learners_of_rollouts_refuse_it() -> None:
    with pytest.raises(UsageError, match="precision"):
        resolve("trpo", "Hopper-v5", {"precision": "bf16"})
    with pytest.raises(UsageError, match=r"precision: .*did you mean bf16"):
        resolve("td3", "Hopper-v5", {"precision": "f16"})

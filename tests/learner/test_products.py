"""Products by libxsmm and oneDNN: NumPy's whatever their shape, repeatable, only where asked."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from short_runs import assert_same, run_to_end
from stopping import stop_at

from pacesetter import algorithms
from pacesetter.batch import Layout, Spec
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.learner import products
from pacesetter.learner.compiled import CompiledLearner
from pacesetter.learner.precision import bfloat16_products
from pacesetter.learner.products import by_library, way
from pacesetter.networks import batch_renorm, mlp
from pacesetter.training.trainer import Trainer

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)
CALL = products.LIBRARIES["libxsmm"].target
built = pytest.mark.skipif(products.loaded("libxsmm") is None, reason="libxsmm is not built in")
both_built = pytest.mark.parametrize(
    "precision",
    [
        pytest.param(
            library.precision,
            marks=pytest.mark.skipif(not products.loaded(name), reason=f"{name} is not built in"),
        )
        for name, library in products.LIBRARIES.items()
    ],
)
NAMES = {library.precision: name for name, library in products.LIBRARIES.items()}
SHAPES = (
    (256, 256, 256),
    (64, 256, 23),
    (17, 300, 400),
    (16, 16, 16),
    (33, 63, 65),
    (512, 64, 128),
)


@pytest.fixture(autouse=True)
def _asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(products.VARIABLE, "libxsmm")


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """As if nothing had been built."""
    gone = {
        name: library._replace(file=tmp_path / "absent.so")
        for name, library in products.LIBRARIES.items()
    }
    monkeypatch.setattr(products, "LIBRARIES", gone)
    products.loaded.cache_clear()
    yield
    products.loaded.cache_clear()


class OtherProcessor:
    """A library that knows no product on this processor."""

    def __init__(self, file: str, **mode: Any) -> None:
        self.product, self.fits = None, lambda *sizes: False


def test_a_library_for_another_processor_is_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that no run's record names a maker of products who makes none."""
    monkeypatch.setattr(products.ctypes, "CDLL", OtherProcessor)
    monkeypatch.setattr(jax.ffi, "pycapsule", lambda function: function)
    monkeypatch.setattr(jax.ffi, "register_ffi_target", lambda *words, **more: None)
    products.loaded.cache_clear()
    try:
        assert [*map(way, NAMES)] == ["xla", "xla"]
    finally:
        products.loaded.cache_clear()


def normal(*shape: int) -> Any:
    return jnp.asarray(RNG.standard_normal(shape), jnp.float32)


def libxsmm_products(function: Any) -> Any:
    return by_library(function, "f32")


def calls(function: Any, *arguments: Any) -> int:
    """How many products of a function libxsmm makes."""
    return calls_in(jax.make_jaxpr(libxsmm_products(function))(*arguments).jaxpr, CALL)


def calls_in(program: Any, target: str) -> int:
    """The same of a traced function, those in a loop counted once."""
    inner = [
        each.jaxpr for e in program.eqns for each in e.params.values() if hasattr(each, "jaxpr")
    ]
    own = [e for e in program.eqns if e.params.get("target_name") == target]
    return len(own) + sum(calls_in(each, target) for each in inner)


def update_of(name: str, precision: str) -> str:
    """The program of a learner's update, as XLA gets it."""
    learner = algorithms.find(name).build(Spec(17, 6), resolve(name, "HalfCheetah-v5").hyper)
    layout = Layout(Spec(17, 6))
    compiled = CompiledLearner(learner, layout, 0, False, precision)
    rows = np.zeros((learner.updates_per_call, 64, layout.width), np.float32)
    still = np.zeros(17, np.float32), np.ones(17, np.float32)
    (state,), key = compiled.init(1, same=False), np.zeros(2, np.uint32)
    return compiled._update.lower(state, rows, None, still, {}, {}, key).as_text()


def assert_close(found: Any, expected: Any) -> None:
    """Within 1e-5 of the whole's size, as float32 sums in another order are."""
    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    assert found.shape == expected.shape
    assert np.linalg.norm(found - expected) <= 1e-5 * np.linalg.norm(expected)


@built
@pytest.mark.parametrize(("m", "n", "k"), SHAPES)
@pytest.mark.parametrize("stack", [(), (2,), (3, 2)])
def test_a_product_and_its_gradients_are_numpys(
    stack: tuple[int, ...], m: int, n: int, k: int
) -> None:
    """Each of the three is libxsmm's, and the sums in float64 tell whether it is right."""
    x, w, along = normal(*stack, m, k), normal(*stack, k, n), normal(*stack, m, n)

    def function(x: Any, w: Any) -> Any:
        y = x @ w
        return jnp.vdot(y, along), y

    both = jax.value_and_grad(function, argnums=(0, 1), has_aux=True)
    assert calls(both, x, w) == 3
    (_, product), (to_x, to_w) = jax.jit(libxsmm_products(both))(x, w)
    a, b, c = (np.asarray(array, np.float64) for array in (x, w, along))
    assert_close(product, a @ b)
    assert_close(to_x, c @ b.swapaxes(-1, -2))
    assert_close(to_w, a.swapaxes(-1, -2) @ c)


@built
def test_pairs_of_networks_loops_and_forward_derivatives() -> None:
    """`mlp.each` over critics, batch renorm, a scan, and what TRPO's Fisher product asks for."""
    critics = jax.vmap(lambda key: mlp.init(key, 23, (256, 96), 1))(jax.random.split(KEY, 2))
    normed = batch_renorm.init(KEY, 17, (64, 64), 12)
    observation, action = normal(64, 17), normal(64, 6)

    def function(critics: Any, normed: Any) -> Any:
        def value(critics: Any) -> Any:
            return (mlp.each(mlp.outputs, critics, observation, action) ** 2).mean()

        trained, _ = batch_renorm.train(normed, observation, jnp.array(True))
        changed, _ = jax.lax.scan(
            lambda net, _: (jax.tree.map(jnp.subtract, net, jax.grad(value)(net)), None),
            critics, None, length=3,
        )  # fmt: skip
        plain = batch_renorm.fold(normed)
        out, linear = jax.linearize(lambda network: mlp.apply(network, observation), plain)
        (turned,) = jax.linear_transpose(linear, plain)(out)
        return changed, trained, linear(plain), turned

    assert calls(function, critics, normed) > 10
    found, expected = (jax.jit(f)(critics, normed) for f in (libxsmm_products(function), function))
    jax.tree.map(assert_close, found, expected)


@built
def test_what_does_not_fit_stays_xlas() -> None:
    x, w = normal(64, 64), normal(64, 64)
    with jax.enable_x64(True):
        wide = np.asarray(x, np.float64)
        assert calls(jnp.matmul, wide, wide) == 0
    for one, other in (
        (x[:15], w), (x, w[:, :15]), (x[:, :15], w[:15]), (x[0], w), (x, w[:, 0]), (x[:0], w),
        (x.astype(int), w.astype(int)), (x.astype(jnp.bfloat16), w.astype(jnp.bfloat16)),
    ):  # fmt: skip
        assert calls(jnp.matmul, one, other) == 0
    turned = jax.make_jaxpr(libxsmm_products(lambda x, w: x.T @ w.T))(x, w)
    assert_close(jax.core.eval_jaxpr(turned.jaxpr, turned.consts, x, w)[0], x.T @ w.T)
    several = lambda x: jnp.einsum("abc,dbc->ad", x, x)  # noqa: E731
    assert calls(several, normal(16, 16, 16)) == 0


@both_built
def test_in_bfloat16_a_product_and_its_gradients_are_numpys_of_rounded_operands(
    precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For stacks, pairs and single matrices, whose rows two threads share where they are even."""
    if precision != "bf16":
        pytest.skip("in float32 the same is tested above")
    monkeypatch.setenv(products.VARIABLE, "onednn")
    target = products.LIBRARIES["onednn"].target
    for stack, m, n, k in (((), 256, 256, 256), ((), 255, 130, 300), ((2,), 128, 64, 512)):
        x, w, along = normal(*stack, m, k), normal(*stack, k, n), normal(*stack, m, n)
        both = jax.value_and_grad(lambda x, w, a=along: jnp.vdot(x @ w, a), argnums=(0, 1))
        low = by_library(bfloat16_products(both), "bf16")
        assert calls_in(jax.make_jaxpr(low)(x, w).jaxpr, target) == 3
        value, (to_x, to_w) = jax.jit(low)(x, w)
        a, b, c = (np.asarray(each.astype(jnp.bfloat16), np.float64) for each in (x, w, along))
        np.testing.assert_allclose(value, ((a @ b) * np.asarray(along)).sum(), rtol=1e-3)
        assert_close(to_x, c @ b.swapaxes(-1, -2))
        assert_close(to_w, a.swapaxes(-1, -2) @ c)


@both_built
def test_results_repeat_bit_for_bit_whatever_the_threads(precision: str) -> None:
    """In this process again and again, and in others with other numbers of threads."""
    program = f"""
import hashlib, jax, jax.numpy as jnp
from pacesetter.learner.precision import bfloat16_products
from pacesetter.learner.products import by_library
x, w = (jnp.sin(jnp.arange(2 * 256 * 256.0).reshape(2, 256, 256) * f) for f in (1.0, 0.3))
products = lambda x, w: (x @ w, x @ w.mT, x.mT @ w, x[0] @ w[0], x[0].T @ w[0])
if "{precision}" == "bf16":
    products = bfloat16_products(products)
product = jax.jit(by_library(products, "{precision}"))
hashed = lambda: hashlib.sha256(b"".join(a.tobytes() for a in product(x, w)))
print({{hashed().hexdigest() for _ in range(50)}})
"""
    found: set[str] = set()
    for threads in ("1", "2", "5"):
        asked = f"{products.VARIABLE}={NAMES[precision]}"
        words = ["env", f"NPROC={threads}", asked, sys.executable, "-c", program]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        found.add(done.stdout)
    assert len(found) == 1
    assert found.pop().count("'") == 2


def test_who_makes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    made = {name: name if products.loaded(name) else "xla" for name in products.LIBRARIES}
    assert (way(), way("bf16")) == (made["libxsmm"], "xla")
    for value, low in (("xla", "xla"), ("", made["onednn"]), ("onednn", made["onednn"])):
        monkeypatch.setenv(products.VARIABLE, value)
        assert (way(), way("bf16")) == ("xla", low)
        assert products.notes(None) == []
    monkeypatch.setenv(products.VARIABLE, "yes")
    with pytest.raises(UsageError, match=rf"{products.VARIABLE}.*'yes'.*libxsmm, onednn, xla"):
        way()
    monkeypatch.setenv(products.VARIABLE, "libxsmm")
    monkeypatch.setattr(products, "platform", lambda: "gpu")
    assert way() == "xla"
    assert products.notes(None) == []


@both_built
def test_an_update_calls_what_is_asked_for_in_its_precision_alone(
    precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(products.VARIABLE, NAMES[precision])
    for other in NAMES:
        text, target = update_of("td3", other), products.LIBRARIES[NAMES[precision]].target
        assert (target in text) == (other == precision)
        assert ("bf16" in text) == (other == "bf16")


@pytest.mark.usefixtures("absent")
@pytest.mark.parametrize("precision", NAMES)
def test_without_the_library_xla_makes_them_and_a_line_says_so(
    precision: str, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(products.VARIABLE, NAMES[precision])
    assert "pacesetter_" not in update_of("td3", precision)
    given: dict[str, Any] = {"steps": 20, "eval_episodes": 1, "precision": precision}
    trainer = Trainer("td3", "Hopper-v5", runs=runs, **given)
    (note,) = trainer.notes
    assert NAMES[precision] in note
    assert "\n" not in note
    assert trainer.directory.record()["products"] == "xla"
    list(trainer)


@both_built
def test_a_run_resumes_bit_for_bit_and_says_so_if_another_makes_them(
    precision: str, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(products.VARIABLE, NAMES[precision])
    settings: dict[str, Any] = {
        "precision": precision,
        "steps": 400, "warmup": 100, "hidden": (64, 64), "batch_size": 64, "eval_episodes": 1,
        "eval_every": 1_000, "checkpoint_every": 3600,
    }  # fmt: skip
    whole, stopped, other = (
        Trainer("td3", "HalfCheetah-v5", runs=runs, name=name, **settings) for name in "abc"
    )
    assert whole.directory.record()["products"] == NAMES[precision]
    stop_at(stopped, 217)
    stopped = Trainer.resume(stopped.directory.path)
    assert stopped.notes == []
    assert_same(run_to_end(whole), run_to_end(stopped))

    stop_at(other, 217)
    monkeypatch.setenv(products.VARIABLE, "xla")
    other = Trainer.resume(other.directory.path)
    (note,) = other.notes
    assert f"products by {NAMES[precision]}, going on with xla" in note
    assert other.directory.record()["resumed"][0]["products"] == "xla"
    run_to_end(other)
    actors = [jax.tree.leaves(trainer.loop.learners.states[0].actor) for trainer in (whole, other)]
    assert any((x != y).any() for x, y in zip(*actors, strict=True))

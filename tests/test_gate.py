"""The speed gate: what is stable on a noisy machine. Seconds are for benchmarks/."""

import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from pacesetter import algorithms
from pacesetter.batch import Layout, Spec
from pacesetter.config import resolve
from pacesetter.learner.backend import prepare
from pacesetter.learner.compiled import CompiledLearner
from pacesetter.training.trainer import Trainer

HALF_CHEETAH = Spec(17, 6)
WORK = {
    "td3": 414.6e6,
    "sac": 581.6e6,
}  # FLOP an update of its matrix products (benchmarks/ceiling.py)
CALLS = 100  # Python calls a step of one td3 member; it is 98.5


def costs(name: str) -> dict[str, float]:
    """XLA's own count for one compiled cycle, by update."""
    config = resolve(name, "HalfCheetah-v5")
    algorithm = algorithms.find(name).build(HALF_CHEETAH, config.hyper)
    layout = Layout(HALF_CHEETAH)
    compiled = CompiledLearner(algorithm, layout, 0, normalize=False)
    state = jax.eval_shape(algorithm.init, jax.random.key(0))
    rows = jax.ShapeDtypeStruct((algorithm.updates_per_call, 256, layout.width), np.float32)
    still = np.zeros(17, np.float32), np.ones(17, np.float32)
    key = np.zeros(2, np.uint32)
    lowered = compiled._update.lower(state, rows, None, still, {}, {}, key)
    found: Any = lowered.compile().cost_analysis()
    return {key: found[key] / algorithm.updates_per_call for key in ("flops", "bytes accessed")}


@pytest.mark.parametrize(("name", "megabytes"), [("td3", 36), ("sac", 52)])
def test_an_update_computes_little_but_its_matrix_products(
    name: str, megabytes: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most 3% of arithmetic beside them, and no array moved more often than now."""
    monkeypatch.setenv("PACESETTER_PRODUCTS", "xla")  # it cannot count what libxsmm computes
    found = costs(name)
    assert WORK[name] <= found["flops"] <= 1.03 * WORK[name]
    assert found["bytes accessed"] <= megabytes * 1e6


def test_programs_are_kept_apart_by_the_cores_they_were_compiled_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One from a pinned run, which splits no loop, would slow down a run on two cores by 8%."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = jax.config.jax_compilation_cache_dir
    kept: set[Path] = set()
    for threads, cores in (("1", {0}), ("2", {0}), ("2", {0, 1})):
        monkeypatch.setenv("NPROC", threads)
        monkeypatch.setattr("os.sched_getaffinity", lambda process, cores=cores: cores)
        prepare("cpu")
        kept.add(Path(jax.config.jax_compilation_cache_dir or ""))
    jax.config.update("jax_compilation_cache_dir", before)
    assert len(kept) == 3
    assert all(folder.is_relative_to(tmp_path) for folder in kept)


def test_nothing_is_compiled_after_the_first_round(tmp_path: Path) -> None:
    """Whoever waits, whatever is due: rounds of members that end at different steps included."""
    compiled: list[bool] = []
    settings: dict[str, Any] = {"warmup": 50, "steps": 1500, "hidden": (8,), "batch_size": 8}
    trainer = Trainer(
        "multi-td3", "probe_envs:Scripted-v0", runs=tmp_path, eval_episodes=1, **settings
    )
    watching = False

    def listen(event: str, duration: float, **details: Any) -> None:
        if "backend_compile" in event:
            compiled.append(watching)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for report in trainer:
            watching = watching or report.kind == "select"
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert trainer.loop.selector.selections > 3
    assert compiled, "nothing was seen to be compiled at all"
    assert not any(compiled)


def test_python_calls_of_a_step(tmp_path: Path) -> None:
    """Counted by the interpreter: collecting, one update a step, bookkeeping, nothing else."""
    trainer = Trainer(
        "td3", "HalfCheetah-v5", runs=tmp_path, warmup=20, hidden=(8,), batch_size=8, steps=10**4
    )
    loop, calls = trainer.loop, 0
    for _ in range(30):
        loop.tick()

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += event == "call"

    sys.setprofile(count)
    try:
        for _ in range(100):
            loop.tick()
    finally:
        sys.setprofile(None)
    trainer.close()
    assert calls / 100 <= CALLS

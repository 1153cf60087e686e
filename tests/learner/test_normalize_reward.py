"""`--normalize-reward`: rewards over the running standard deviation of discounted returns."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numeric import SPEC
from short_runs import TINY

from pacesetter import Trainer, algorithms
from pacesetter.batch import Layout
from pacesetter.config import resolve
from pacesetter.learner.compiled import CompiledLearner, UpdateInputs

SMALL: dict[str, Any] = {"hidden": (8,), "normalize_reward": True}
CASES: dict[str, dict[str, Any]] = {
    "td3": SMALL,
    "sac": SMALL,
    "crossq": {**SMALL, "critic_hidden": (8,)},
    "crossq-bins": {**SMALL, "critic_hidden": (8,), "normalize_reward": False},
}


def critic_after(name: str, reward: float, deviation: float) -> list[Any]:
    """The critic's weights after one update on rewards times `reward`."""
    config = resolve(name, "Walker2d-v5", CASES[name])
    learner = algorithms.find(config.run.algorithm)(SPEC, config.hyper)
    layout = Layout(SPEC)
    compiled = CompiledLearner(learner, layout, seed=0, normalize=False)
    shape = (learner.updates_per_call, 16, layout.width)
    rows = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    rows[..., SPEC.observation_size + SPEC.action_size] *= reward
    (state,) = compiled.init(1, same=False)
    extra = {"return_deviation": np.float32(deviation)}
    statistics = np.zeros(3, np.float32), np.ones(3, np.float32)
    update = compiled.update(state, 0, UpdateInputs(0, rows, None, statistics, extra))
    assert np.isfinite(update.losses).all()
    return jax.tree.leaves(update.state.critic)


@pytest.mark.parametrize("name", CASES)
def test_ten_times_both_changes_nothing_and_one_alone_does(name: str) -> None:
    first, same, other = (
        critic_after(name, *factors) for factors in ((1.0, 2.0), (10.0, 20.0), (10.0, 2.0))
    )
    for one, two in zip(first, same, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-3, atol=1e-5)
    assert any(not np.allclose(a, b, atol=1e-4) for a, b in zip(first, other, strict=True))


def test_a_run_keeps_the_deviation_and_evaluates_plain_rewards(runs: Path) -> None:
    settings: dict[str, Any] = {**TINY, "steps": 300, "runs": runs}
    scaled = Trainer("td3", "Pendulum-v1", name="scaled", normalize_reward=True, **settings)
    reports = [report for report in scaled if report.kind == "eval"]
    assert scaled.loop.experience.return_scale.sums[0] == 300
    assert scaled.loop.experience.return_scale.deviation > 1
    plain = Trainer("td3", "Pendulum-v1", **settings)
    assert plain.loop.experience.return_scale is None
    (first, *_) = [report for report in plain if report.kind == "eval"]
    assert first.values["returns"] == reports[0].values["returns"]  # both untrained

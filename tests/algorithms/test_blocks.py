"""Critic heads: the quantile head, LAP's loss and the mean, each against a form of its own."""

from typing import Any

import jax
import numpy as np
import pytest
from numeric import KEY, SPEC, member, perceptron, quantile_loss, random_batch, random_state, says
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import td3
from pacesetter.algorithms.sac import SAC
from pacesetter.algorithms.td3 import TD3
from pacesetter.networks import critic_heads
from pacesetter.settings import STRICT

DISTRIBUTION = np.arange(1.0, 6.0)


def test_quantile_loss_is_the_sum_over_pairs(rng: np.random.Generator) -> None:
    """Two critics, rows and numbers of outputs and targets that differ, one pair at a time."""
    outputs, target = rng.normal(size=(2, 4, 5), scale=2), rng.normal(size=(4, 3), scale=2)
    with jax.enable_x64(True):
        loss, error = critic_heads.quantile_huber(outputs, target)
    expected = [
        [quantile_loss(o, t) for o, t in zip(rows, target, strict=True)] for rows in outputs
    ]
    np.testing.assert_allclose(loss, expected, rtol=1e-12)
    np.testing.assert_allclose(error, np.abs(outputs.mean(-1) - target.mean(-1)), rtol=1e-12)


@pytest.mark.parametrize(("target", "expected"), [(0.5, 0.0625), (-0.5, 0.0625), (3, 1.25)])
def test_one_quantile_is_half_a_huber_loss(target: float, expected: float) -> None:
    """Its share is 1/2 on both sides: the median."""
    loss, error = critic_heads.quantile_huber(np.zeros((1, 1), np.float32), np.array([target]))
    assert loss == pytest.approx([expected])
    assert error == pytest.approx([abs(target)])


def test_gradient_of_the_quantile_loss(rng: np.random.Generator) -> None:
    """By differences of the sum over pairs."""
    outputs, target = rng.normal(size=5, scale=2), rng.normal(size=7, scale=2)
    with jax.enable_x64(True):
        slope = jax.grad(lambda x: critic_heads.quantile_huber(x[None], target[None])[0].sum())(
            outputs
        )
    bumps = 1e-6 * np.eye(5)
    expected = [
        (quantile_loss(outputs + bump, target) - quantile_loss(outputs - bump, target)) / 2e-6
        for bump in bumps
    ]
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-9)


def test_quantiles_rest_at_the_quantiles() -> None:
    """Of returns spread evenly over 0 to 1000, output i rests at 1000 (i + 1/2) / 25."""
    target = np.linspace(0, 1000, 20_001, dtype=np.float32)[None]
    rest = np.float32(1000 * (np.arange(25) + 0.5) / 25)
    slope = jax.jit(jax.grad(lambda x: critic_heads.quantile_huber(x[None], target)[0].sum()))
    np.testing.assert_allclose(slope(rest), 0, atol=1e-3)
    np.testing.assert_allclose(slope(rest + 15), 0.015, atol=1e-3)
    np.testing.assert_allclose(slope(rest - 15), -0.015, atol=1e-3)


def test_a_certain_return_is_a_distribution_of_one_number(rng: np.random.Generator) -> None:
    """A target (B,) counts as (B, 1)."""
    outputs = rng.normal(size=(2, 4, 5)).astype(np.float32)
    target = rng.normal(size=4).astype(np.float32)
    one, other = (critic_heads.quantile_huber(outputs, t) for t in (target, target[:, None]))
    np.testing.assert_array_equal(one, other)


def test_min_q_is_the_whole_distribution_of_the_lower_twin() -> None:
    """Row by row, by the mean alone: neither number by number nor the twin with the least one."""
    outputs = np.array([[[0.0, 10], [5, 5]], [[4, 5], [-20, 40]]])
    found = critic_heads.choose(2, "uniform").min_q(outputs)
    np.testing.assert_array_equal(found.T, [[4, 5], [5, 5]])


def test_min_q_of_single_outputs_is_their_minimum(rng: np.random.Generator) -> None:
    outputs = rng.normal(size=(3, 8, 1)).astype(np.float32)
    for head in (critic_heads.choose(0, "uniform"), critic_heads.choose(1, "uniform")):
        np.testing.assert_array_equal(head.min_q(outputs), outputs[..., 0].min(axis=0))


def test_loss_of_lap() -> None:
    """Half the square below 1, the line above: gradients e, then the sign of e, without a jump."""
    errors = np.array([0, 0.5, -0.5, 0.999, 1.001, 2, -3])
    with jax.enable_x64(True):
        loss, error = critic_heads.lap(errors[:, None], np.zeros(7))
        slope = jax.grad(lambda x: critic_heads.lap(x, np.zeros(7))[0].sum())(errors[:, None])[:, 0]
    np.testing.assert_allclose(loss, [0, 0.125, 0.125, 0.999**2 / 2, 1.001, 2, 3])
    np.testing.assert_allclose(slope, [0, 0.5, -0.5, 0.999, 1, 1, -1])
    np.testing.assert_array_equal(error, np.abs(errors))


def test_heads_by_the_settings() -> None:
    """LAP's replay brings its loss; any other leaves the squared one; quantiles have their own."""
    assert critic_heads.choose(0, "uniform").loss is critic_heads.squared
    assert critic_heads.choose(0, "prioritized").loss is critic_heads.squared
    assert critic_heads.choose(0, "lap").loss is critic_heads.lap
    assert critic_heads.choose(25, "uniform").outputs == 25


def test_head_of_quantiles_has_their_loss(rng: np.random.Generator) -> None:
    """For a target as `min_q` leads to it, which is (M, B)."""
    outputs, target = np.float32(rng.normal(size=(2, 4, 5))), np.float32(rng.normal(size=(5, 4)))
    found = critic_heads.choose(5, "uniform").loss(outputs, target)
    expected = critic_heads.quantile_huber(outputs, target.T)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@settings(frozen=True, kw_only=True, config=STRICT)
class LapHyper(td3.Hyper):
    """TD3's settings with a replay that asks for LAP's loss."""

    replay: Any = "lap"


def test_lap_in_a_learner(rng: np.random.Generator) -> None:
    """The critics' loss is LAP's, weighted; the replay is told the larger twin's error."""
    with jax.enable_x64(True):
        learner = TD3(SPEC, LapHyper(hidden=(6,)))
        state, batch = random_state(learner, rng, "critic"), random_batch(rng, SPEC, 16)
        y = batch.reward * 2
        _, loss, fed = jax.jit(learner.fit_critic)(state, batch, y, batch.weight)
    inputs = np.concatenate([batch.observation, batch.action], axis=1)
    values = np.array([perceptron(member(state.critic, i), inputs)[:, 0] for i in range(2)])
    errors = np.abs(values - y)
    assert 0 < np.mean(errors < 1) < 1
    rows = np.where(errors < 1, errors**2 / 2, errors)
    np.testing.assert_allclose(loss, (batch.weight * rows).mean(axis=1).sum())
    np.testing.assert_allclose(fed, errors.max(axis=0))


@pytest.mark.parametrize("kind", [TD3, SAC])
def test_target_is_a_distribution(kind: Any, rng: np.random.Generator) -> None:
    """r + discount * each number of the lower twin, after a fall r alone, for SAC less entropy."""
    learner = kind(SPEC, kind.Hyper(hidden=(6,), quantiles=5))
    state = random_state(learner, rng, "actor")
    twins = says(state.target_critic, [DISTRIBUTION + 10, DISTRIBUTION])
    state = state._replace(target_critic=twins)
    batch = random_batch(rng, SPEC, 8)._replace(reward=np.full(8, 1.5))
    batch.discount[:2] = 0.99, 0
    y = np.asarray(jax.jit(learner.target)(state, batch, KEY))
    assert y.shape == (5, 8)
    entropy = y[:, 0] - (1.5 + 0.99 * DISTRIBUTION)
    np.testing.assert_allclose(entropy, entropy[0], rtol=1e-4, atol=1e-5)
    assert (kind is SAC) == bool(abs(entropy[0]) > 1e-3)
    np.testing.assert_allclose(y[:, 1], 1.5, rtol=1e-6)


@pytest.mark.parametrize("kind", [TD3, SAC])
def test_value_of_quantiles_is_their_mean(kind: Any, rng: np.random.Generator) -> None:
    learner = kind(SPEC, kind.Hyper(hidden=(6,), quantiles=5))
    state = random_state(learner, rng)
    critic = says(state.critic, [DISTRIBUTION, DISTRIBUTION - 1])
    batch = random_batch(rng, SPEC, 4)
    values = jax.jit(learner.values)(critic, batch.observation, batch.action)
    np.testing.assert_allclose(values, [[3] * 4, [2] * 4], rtol=1e-6)

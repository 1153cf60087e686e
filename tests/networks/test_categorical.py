"""The categorical head, computed again in NumPy with loops, and the scale of its rewards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pacesetter.learner.normalizer import ReturnScale
from pacesetter.networks.critic_heads import categorical, project

COUNT = 11
BINS = np.linspace(-5, 5, COUNT)


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def share_out(shares: np.ndarray, places: np.ndarray) -> np.ndarray:
    """C51's projection, bin by bin (Bellemare et al. 2017, algorithm 1)."""
    found = np.zeros_like(shares)
    for row, (own, at) in enumerate(zip(shares, places, strict=True)):
        for share, place in zip(own, at, strict=True):
            position = (np.clip(place, -5, 5) + 5) / (BINS[1] - BINS[0])
            low, high = int(np.floor(position)), int(np.ceil(position))
            if low == high:
                found[row, low] += share
            else:
                found[row, low] += share * (high - position)
                found[row, high] += share * (position - low)
    return found


def test_target_and_loss_are_those_of_numpy(rng: np.random.Generator) -> None:
    """Three critics, six transitions, one of which ends; some returns lie beyond the last bin."""
    later, now = rng.normal(size=(2, 3, 6, COUNT), scale=2)
    reward, bonus = rng.normal(size=(2, 6), scale=2)
    discount = np.array([0.99, 0.9, 0.5, 0, 0.99, 0.99])
    head = categorical(COUNT)
    values = softmax(later) @ BINS
    lowest = values.argmin(axis=0)
    shares = softmax(later[lowest, np.arange(6)])
    target = share_out(shares, reward[:, None] + discount[:, None] * (BINS + bonus[:, None]))
    found = head.target(*map(jnp.asarray, (later, reward, discount, bonus)))
    np.testing.assert_allclose(found, target, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(head.value(jnp.asarray(later)), values, rtol=1e-4, atol=1e-5)
    loss, td_error = head.loss(jnp.asarray(now), found)
    entropy = -(target * np.log(softmax(now))).sum(axis=-1)
    np.testing.assert_allclose(loss, entropy, rtol=1e-4)
    np.testing.assert_allclose(td_error, abs(target @ BINS - softmax(now) @ BINS), rtol=1e-3)


def test_shares_stay_one_and_keep_their_mean_inside() -> None:
    """Whatever is shared out sums to 1; its mean is kept where nothing lies beyond the last bin."""
    shares = jnp.full((2, COUNT), 1 / COUNT)
    places = jnp.stack([jnp.asarray(BINS) * 0.37 + 0.2, jnp.asarray(BINS) + 3])
    found = project(shares, places)
    np.testing.assert_allclose(found.sum(axis=-1), 1, rtol=1e-6)
    assert float(found[0] @ BINS) == pytest.approx(0.2, abs=1e-5)
    assert float(found[1, -1]) == pytest.approx(4 / COUNT)  # 5, 6, 7 and 8
    np.testing.assert_allclose(project(shares, jnp.tile(BINS, (2, 1))), shares, atol=1e-6)


def test_gradient_moves_towards_the_target() -> None:
    """At its minimum the softmax is the target itself."""
    target = jnp.asarray(softmax(np.random.default_rng(0).normal(size=(4, COUNT))))
    head = categorical(COUNT)
    gradient = jax.grad(lambda outputs: head.loss(outputs, target)[0].sum())
    np.testing.assert_allclose(gradient(jnp.log(target)), 0, atol=1e-6)


def test_scale_is_the_deviation_of_all_discounted_returns(rng: np.random.Generator) -> None:
    """Two envs by turns, whose episodes end at their own times; told again from the lists."""
    scale, told = ReturnScale(0.9, 2), list[float]()
    assert scale.deviation == 1
    rewards: list[list[float]] = [[], []]
    for step in range(60):
        env = step % 2
        reward, last = float(rng.normal()), step % 7 == 0
        rewards[env].append(reward)
        told.append(sum(0.9**age * r for age, r in enumerate(reversed(rewards[env]))))
        scale.add(env, reward, last)
        if last:
            rewards[env] = []
    assert scale.deviation == pytest.approx(np.std(told), rel=1e-6)
    other = ReturnScale(0.9, 2)
    other.restore(scale.table(), scale.arrays())
    for each in (scale, other):
        each.add(0, 1.0, False)
    assert other.deviation == scale.deviation

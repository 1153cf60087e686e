"""The dynamics ensemble and its fit: known tasks, statistics by hand, who learns from which row."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numeric import SPEC, member, same

from pacesetter.batch import Batch
from pacesetter.dynamics import fit as fitting
from pacesetter.dynamics.model import (
    DETERMINISTIC,
    GAUSSIAN,
    LOG_VARIANCE_RANGE,
    Dynamics,
    Known,
    bounded,
    quantities,
)

KEY = jax.random.key(5)
SMALL = Dynamics(SPEC, members=3, hidden=(24, 24), head_hidden=(12,), learning_rate=3e-3)
CHANGE = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
fit = jax.jit(fitting.fit, static_argnames=("dynamics", "batch_size"))


def rows(*shape: int, seed: int = 0, noise: Any = None) -> Batch:
    """Transitions of a linear task with numbers of very different size.

    Its reward is the first number reached, and it ends where the first number reached is above 0.
    """
    rng = np.random.default_rng(seed)
    size = np.array([1, 100, 0.01], np.float32)
    observation = size * rng.normal(size=(*shape, 3)).astype(np.float32)
    action = rng.uniform(-1, 1, (*shape, 2)).astype(np.float32)
    change = np.concatenate([observation / size, action], axis=-1) @ CHANGE
    if noise is not None:
        change = change + noise(action) * rng.normal(size=change.shape)
    following = (observation + size * change).astype(np.float32)
    falls = following[..., 0] > 0
    return Batch(
        observation,
        action,
        following[..., 0],
        following,
        discount=np.where(falls, 0, 0.99).astype(np.float32),
        last=falls.astype(np.float32),
        weight=np.ones(shape, np.float32),
        mask=np.zeros((*shape, 0), np.float32),
    )


def stacked(batch: Batch, members: int = 3) -> Any:
    return jax.tree.map(lambda x: np.stack([x] * members), batch)


@pytest.fixture(scope="module")
def fitted() -> fitting.Fit:
    return fit(SMALL, SMALL.init(KEY), rows(3_000), KEY, batch_size=64, patience=5, epochs=60)


# What is learned.


def test_a_linear_task_is_learned(fitted: fitting.Fit) -> None:
    """The error is small in every number, whatever its units, and so are those of the heads."""
    new = rows(2_000, seed=9)
    each = stacked(new)
    mean, _ = SMALL.predict(fitted.models, each.observation, each.action)
    assert mean.shape == (3, 2_000, 3)
    change = new.next_observation - new.observation
    assert np.all(np.mean((mean - new.next_observation) ** 2, axis=1) < 0.01 * change.var(axis=0))
    transition = (each.observation, each.action, each.next_observation)
    reward = SMALL.reward(fitted.models, new.observation, new.action, new.next_observation)
    assert reward.shape == (3, 2_000)
    assert np.all(np.mean((reward - new.reward) ** 2, axis=1) < 0.01 * np.var(new.reward))
    ended = SMALL.terminated(fitted.models, *transition)
    assert ended.shape == (3, 2_000)
    wrong = (ended > 0.5) != (new.discount == 0)
    assert np.all(wrong.mean(axis=1) < 0.02)


def test_held_out_loss_is_that_of_the_models_given_back(fitted: fitting.Fit) -> None:
    """Computed again in NumPy from the rows that lie in held-out blocks of 50."""
    data = rows(3_000)
    aside = np.arange(3_000) // 50 % 5 == 4
    each = stacked(jax.tree.map(lambda x: x[aside], data))
    transition = (each.observation, each.action, each.next_observation)
    mean, _ = SMALL.predict(fitted.models, *transition[:2])
    deviation = (data.next_observation - data.observation)[~aside].std(axis=0)
    expected = 0.5 * (((mean - each.next_observation) / deviation) ** 2).sum(axis=2)
    own = np.arange(3)
    reward = SMALL.reward(fitted.models, *transition)[own, own]
    expected += 0.5 * ((reward - each.reward) / data.reward[~aside].std()) ** 2
    ended = np.asarray(SMALL.terminated(fitted.models, *transition), float)
    expected -= np.log(np.where(each.discount == 0, ended, 1 - ended))
    np.testing.assert_allclose(fitted.loss, expected.mean(axis=1), rtol=1e-3)


def test_noise_is_learned_by_the_gaussian_form() -> None:
    """Deviation .4 or 1.2 by the sign of the first action, in the units of each number."""
    dynamics = replace(SMALL, form=GAUSSIAN)

    def noise(action: Any) -> Any:
        return np.where(action[..., :1] > 0, 1.2, 0.4)

    data = rows(6_000, noise=noise)
    models = fit(dynamics, dynamics.init(KEY), data, KEY, batch_size=256, epochs=40).models
    each = stacked(rows(1_000, seed=3))
    mean, deviation = dynamics.predict(models, each.observation, each.action)
    size = np.array([1, 100, 0.01])
    clear = np.abs(each.action[0, :, 0]) > 0.2
    ratio = (deviation / size / noise(each.action))[:, clear]
    np.testing.assert_allclose(ratio.mean(axis=(0, 1)), 1, atol=0.15)
    drawn = np.stack(
        [dynamics.sample(models, each.observation, each.action, jax.random.key(i)) for i in (1, 2)]
    )
    spread = (drawn[0] - drawn[1]).std(axis=(0, 1)) / np.sqrt(2)
    np.testing.assert_allclose(spread, np.sqrt((deviation**2).mean(axis=(0, 1))), rtol=0.1)
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < 5 * np.asarray(deviation))


def test_log_variance_is_softly_bounded() -> None:
    """In range for any output, the identity well inside, and never without a slope."""
    low, high = LOG_VARIANCE_RANGE
    raw = np.array([-1e4, -30, -5, 0, 5, 1e4], np.float32)
    found = bounded(raw)
    assert np.all((found >= low) & (found <= high + 1e-4))
    np.testing.assert_allclose(found[2], -5, atol=0.02)
    slope = jax.vmap(jax.grad(bounded))(raw[1:5])
    assert np.all(slope > 0)


def test_losses_by_hand() -> None:
    """Of the published forms: half a squared error, and the Gaussian's negative log-likelihood."""
    mean, truth = np.float32([1.0]), np.float32([3.0])
    np.testing.assert_allclose(DETERMINISTIC.loss(mean, mean * 0, truth), 2.0)
    log_variance = np.log(np.float32([4.0]))
    expected = 0.5 * (4 / 4 + np.log(4))
    np.testing.assert_allclose(GAUSSIAN.loss(mean, log_variance, truth), expected, rtol=1e-6)


def test_a_deterministic_sample_is_its_mean(fitted: fitting.Fit) -> None:
    each = stacked(rows(16))
    mean, deviation = SMALL.predict(fitted.models, each.observation, each.action)
    assert not np.any(deviation)
    drawn = SMALL.sample(fitted.models, each.observation, each.action, KEY)
    np.testing.assert_array_equal(drawn, mean)


def test_known_functions_replace_the_heads() -> None:
    """No head is learned, and what they say is what the functions say."""
    known = Known(lambda s, a, t: t[..., 1] - a[..., 0], lambda t: t[..., 0] > 0)
    dynamics = replace(SMALL, known=known)
    models, each = dynamics.init(KEY), stacked(rows(8))
    assert models.networks.reward == models.networks.terminated == ()
    transition = (each.observation, each.action, each.next_observation)
    expected = (each.next_observation[..., 1] - each.action[..., 0])[None]
    np.testing.assert_array_equal(dynamics.reward(models, *transition), expected)
    ended = dynamics.terminated(models, *transition)
    np.testing.assert_array_equal(ended, each.next_observation[..., 0] > 0)
    assert np.all(np.isfinite(dynamics.losses(models.networks, models.scale, each)))


def test_one_member_alone(fitted: fitting.Fit) -> None:
    """A chosen member says what it says among the others."""
    each = stacked(rows(16))
    one = SMALL.choose(fitted.models, 2)
    mean, _ = SMALL.predict(one, each.observation[:1], each.action[:1])
    full, _ = SMALL.predict(fitted.models, each.observation, each.action)
    np.testing.assert_allclose(mean[0], full[2], rtol=1e-6, atol=1e-7)


def test_inputs_far_from_the_data_are_cut(fitted: fitting.Fit) -> None:
    """A state a thousand deviations off moves no further than one that is at ten."""
    far = np.full((3, 1, 3), 1e6, np.float32)
    further = 2 * far
    action = np.zeros((3, 1, 2), np.float32)
    one, _ = SMALL.predict(fitted.models, far, action)
    two, _ = SMALL.predict(fitted.models, further, action)
    np.testing.assert_allclose(one - far, two - further, atol=1)


# Statistics.


def test_moving_statistics_are_those_of_all_rows() -> None:
    """Up to a thousand equal minibatches; a number that never varies keeps a small deviation."""
    models = SMALL.init(KEY)
    batches = [rows(32, seed=i) for i in range(6)]
    batches = [b._replace(action=b.action * np.float32([1, 0])) for b in batches]
    for batch in batches:
        models = SMALL.observe(models, batch)
    values = np.concatenate([quantities(batch) for batch in batches]).astype(float)
    np.testing.assert_allclose(models.scale.mean, values.mean(axis=0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(models.scale.variance, values.var(axis=0), rtol=1e-4, atol=1e-9)
    assert models.scale.deviation[4] == pytest.approx(1e-3)


def test_moving_statistics_forget() -> None:
    """After a thousand minibatches each new one still counts as a thousandth, by raw moments."""
    models, batch = SMALL.init(KEY), rows(32)
    old = models.scale._replace(taken=jnp.int32(5_000))
    new = SMALL.observe(models._replace(scale=old), batch).scale
    values = np.asarray(quantities(batch), float)
    mean = 0.001 * values.mean(axis=0)  # of 0 before, with variance 1
    square = 0.999 + 0.001 * (values**2).mean(axis=0)
    np.testing.assert_allclose(new.mean, mean, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(new.variance, square - mean**2, rtol=1e-4)
    assert new.taken == 5_001


def test_statistics_of_a_fit_are_those_of_its_training_rows() -> None:
    """Neither padding nor held-out rows count."""
    data = rows(400)
    scale = fitting.measure(data, jnp.arange(400) < 300)
    values = np.asarray(quantities(data), float)[:300]
    np.testing.assert_allclose(scale.mean, values.mean(axis=0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(scale.variance, values.var(axis=0), rtol=1e-4)


# Who learns from what.


def test_members_begin_apart_and_learn_from_their_own_rows() -> None:
    """Other rows for member 1 leave member 0 the same bits."""
    models = SMALL.init(KEY)
    kernels = [layer["kernel"] for layer in models.networks.change]
    assert all(np.all(k[0] != k[1]) for k in kernels)
    step = jax.jit(SMALL.step)
    mine, others = stacked(rows(16)), stacked(rows(16))
    jax.tree.map(lambda x, new: x.__setitem__(1, new), others, rows(16, seed=1))
    moments = SMALL.init_opt_state(models)
    one, two = (step(models, moments, batch)[0].networks for batch in (mine, others))
    assert same(member(one, 0), member(two, 0))
    assert not same(member(one, 1), member(two, 1))


def test_a_step_decays_the_weights_and_is_as_long_as_told() -> None:
    """L2 decay adds its share of every weight to the gradient, of which Adam keeps a tenth."""
    batch, decay = stacked(rows(16)), 0.3
    models = SMALL.init(KEY)
    found: list[Any] = []
    for dynamics in (SMALL, replace(SMALL, decay=decay)):
        start = dynamics.init_opt_state(models)
        moved, opt_state, _ = jax.jit(dynamics.step)(models, start, batch)
        moments = jax.tree.leaves(opt_state, is_leaf=lambda x: hasattr(x, "mu"))
        (mu,) = [each.mu for each in moments if hasattr(each, "mu")]
        found.append(mu)
        steps = jax.tree.map(lambda new, old: np.abs(new - old).max(), moved, models)
        np.testing.assert_allclose(jax.tree.leaves(steps.networks), 3e-3, rtol=1e-3)

    def check(plain: Any, decayed: Any, weight: Any) -> None:
        np.testing.assert_allclose(decayed - plain, 0.1 * decay * weight, rtol=1e-4, atol=1e-6)

    jax.tree.map(check, *found, models.networks)


def padded(batch: Batch, filler: float, slots: int = 1_000, valid: int = 600) -> Batch:
    """The rows in a ring of which only the first are in use."""

    def pad(x: Any) -> Any:
        ring = np.full((slots, *x.shape[1:]), filler, np.float32)
        ring[:valid] = x[:valid]
        return ring

    return jax.tree.map(pad, batch)._replace(valid=np.int32(valid))


TINY = replace(SMALL, hidden=(8,), head_hidden=(4,), learning_rate=0.05)
tiny_fit = partial(fit, TINY, batch_size=32)  # compiled once
KNOWN = Known(lambda s, a, t: t[..., 0], lambda t: t[..., 0] > 0)
LIKELY = replace(TINY, form=GAUSSIAN, known=KNOWN)  # a loss of any sign


def test_padding_is_never_read() -> None:
    """NaN or 7 in the slots not in use: the same bits."""
    models, data = TINY.init(KEY), rows(600)
    one, two = (tiny_fit(models, padded(data, x), KEY, patience=5, epochs=2) for x in (np.nan, 7.0))
    assert np.all(np.isfinite(one.loss))
    assert same(one, two)


def test_held_out_rows_are_not_trained_on() -> None:
    """Other numbers there change the loss after an epoch, and not one bit of the models."""
    models, data = TINY.init(KEY), rows(600)
    changed = jax.tree.map(np.copy, data)
    aside = np.arange(600) // 50 % 5 == 4
    changed.next_observation[aside] += 1
    one, two = (tiny_fit(models, padded(x, 0), KEY, patience=5, epochs=1) for x in (data, changed))
    assert same(one.models, two.models)
    assert np.all(two.loss > one.loss)


@pytest.mark.parametrize(("dynamics", "patience"), [(TINY, 1), (TINY, 3), (LIKELY, 2)])
def test_each_member_ends_at_its_own_best(dynamics: Dynamics, patience: int) -> None:
    """The rule applied by hand to every epoch's networks, with steps so long that losses rise."""
    models, data = dynamics.init(KEY), rows(600)
    found = fit(dynamics, models, padded(data, 0), KEY, 32, patience=patience, epochs=25)
    aside = np.arange(600) // 50 % 5 == 4
    slots = np.flatnonzero(~aside)
    models = models._replace(scale=fitting.measure(data, ~aside))
    held = stacked(jax.tree.map(lambda x: x[aside], data))
    step, check = jax.jit(dynamics.step), jax.jit(dynamics.losses)
    moments = dynamics.init_opt_state(models)
    loss, stale, best = np.full(3, np.inf), np.zeros(3, int), [member(models.networks, 0)] * 3
    epoch = 0
    while (stale < patience).any() and epoch < 25:
        for i in range(-(-len(slots) // 32)):
            key = jax.random.fold_in(jax.random.fold_in(KEY, epoch), i)
            places = slots[jax.random.randint(key, (3, 32), 0, len(slots))]
            batch = jax.tree.map(lambda x, p=places: x[p], data)
            models, moments, _ = step(models, moments, batch)
        now = np.asarray(check(models.networks, models.scale, held))
        for k in range(3):
            if loss[k] - now[k] > 0.01 * abs(now[k]) and stale[k] < patience:
                loss[k], stale[k], best[k] = now[k], 0, member(models.networks, k)
            else:
                stale[k] += 1
        epoch += 1
    assert found.epochs == epoch
    assert (loss < 0).all() == (dynamics is LIKELY)
    assert len(set(stale)) > 1  # they did not end together
    np.testing.assert_allclose(found.loss, loss, rtol=1e-3)
    for k in range(3):
        got = member(found.models.networks, k)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-2, atol=1e-3), got, best[k])


def test_no_key_is_used_twice() -> None:
    models, data, each = TINY.init(KEY), rows(300), stacked(rows(4))
    with jax.debug_key_reuse(True):
        jax.eval_shape(jax.jit(TINY.init), KEY)
        jax.eval_shape(jax.jit(TINY.sample), models, each.observation, each.action, KEY)
        jax.eval_shape(partial(fit, TINY, epochs=2), models, data, KEY)


def test_gamma_0_ends_nothing() -> None:
    """With gamma 0 every discount is 0; the termination heads still learn the true ends."""
    batch = rows(64)
    falls = np.asarray(batch.last) > 0
    assert 0 < falls.mean() < 1
    models = SMALL.observe(SMALL.init(KEY), batch)
    worth = [
        SMALL.losses(models.networks, models.scale, stacked(each))
        for each in (batch, batch._replace(discount=np.zeros_like(batch.discount)))
    ]
    np.testing.assert_array_equal(*worth)

"""CrossQ's options: no gradient through a batch's next half, weights of length 1, and bins."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numeric import KEY, SPEC, close, member, random_batch, random_state, same, slopes, squashed
from short_runs import TINY, run_to_end

from pacesetter.algorithms import crossq
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.networks import batch_renorm, gaussian, mlp
from pacesetter.training.trainer import Trainer


def learner(**hyper: Any) -> crossq.CrossQ:
    small = {"hidden": (5, 4), "critic_hidden": (4, 3), "policy_delay": 1}
    return crossq.CrossQ(SPEC, crossq.Hyper(**{**small, **hyper}))


def batches(rng: np.random.Generator, updates: int = 1) -> Any:
    return jax.tree.map(np.float32, random_batch(rng, SPEC, updates, 8))


def length(layer: Any, with_bias: bool) -> Any:
    """Of the weights into every unit (..., units)."""
    squares = (np.asarray(layer["kernel"], float) ** 2).sum(axis=-2)
    return np.sqrt(squares + with_bias * np.asarray(layer["bias"], float) ** 2)


# No gradient through (s', a').


def normed(layer: Any, rows: Any, joint: Any, at: Any, warm: bool) -> Any:
    """Rows normalised by a joint batch; `at` holds the moments that the correction refers to."""
    running, (mean, variance) = np.sqrt(layer["variance"] + 1e-3), at
    r = np.clip(np.sqrt(variance + 1e-3) / running, 1 / 3, 3) if warm else 1.0
    d = np.clip((mean - layer["mean"]) / running, -5, 5) if warm else 0.0
    return (rows - joint.mean(axis=0)) / np.sqrt(joint.var(axis=0) + 1e-3) * r + d


def through(layer: Any, x: Any) -> Any:
    return (x * layer["scale"] + layer["offset"]) @ layer["kernel"] + layer["bias"]


class Frozen:
    """What the second half, and the moments of both, are in every layer of a critic at one point:
    constants for every critic near it.
    """

    def __init__(self, critic: Any, now: Any, later: Any, warm: bool) -> None:
        self.warm, self.now = warm, now
        self.laters: list[Any] = []
        self.moments: list[Any] = []
        for index, layer in enumerate(critic):
            if index:
                now, later = np.maximum(now, 0), np.maximum(later, 0)
            joint = np.concatenate([now, later])
            self.laters.append(later)
            self.moments.append((joint.mean(axis=0), joint.var(axis=0)))
            now, later = (
                through(layer, normed(layer, rows, joint, self.moments[-1], warm))
                for rows in (now, later)
            )
        self.q, self.next_q = now[:, 0], later[:, 0]

    def value(self, critic: Any) -> Any:
        x = self.now
        for index, layer in enumerate(critic):
            x = np.maximum(x, 0) if index else x
            joint = np.concatenate([x, self.laters[index]])
            x = through(layer, normed(layer, x, joint, self.moments[index], self.warm))
        return x[:, 0]


@pytest.mark.parametrize("warm", [False, True])
def test_critic_step_without_the_next_halfs_gradient(warm: bool, rng: np.random.Generator) -> None:
    """Its gradient is that by differences where the second half stays what it was, all layers."""
    algorithm = learner(renorm_after=0 if warm else 100, next_batch_gradient=False)
    with jax.enable_x64(True):
        old = random_state(algorithm, rng, "actor", "critic")
        batch = member(random_batch(rng, SPEC, 1, 8), 0)
        new, (_, td_error) = jax.device_get(jax.jit(algorithm.fit_critic)(old, batch, KEY))
        noise = np.asarray(jax.random.normal(KEY, (8, 2)))
        folded = jax.device_get(jax.jit(batch_renorm.fold)(old.actor))
    x = batch.next_observation
    for layer in folded[:-1]:
        x = np.maximum(x @ layer["kernel"] + layer["bias"], 0)
    action, log_prob = squashed(x @ folded[-1]["kernel"] + folded[-1]["bias"], noise)
    now = np.concatenate([batch.observation, batch.action], axis=1)
    later = np.concatenate([batch.next_observation, action], axis=1)
    critics = [member(old.critic, i) for i in range(2)]
    at = [Frozen(critic, now, later, warm) for critic in critics]
    next_q = np.minimum(at[0].next_q, at[1].next_q)
    y = batch.reward + batch.discount * (next_q - log_prob)  # alpha is 1
    for i, critic in enumerate(critics):

        def loss(network: Any, frozen: Frozen = at[i]) -> float:
            return float((batch.weight * (frozen.value(network) - y) ** 2).mean())

        slope = slopes(loss, critic)
        half = [
            {k: 0 * v if k in ("mean", "variance") else v / 2 for k, v in layer.items()}
            for layer in slope
        ]
        close(list(member(new.critic_opt_state[0].mu, i)), half)  # Adam's first moment keeps half
        moved = zip(member(new.critic, i), critic, at[i].moments, strict=True)
        for layer, before, (mean, variance) in moved:
            np.testing.assert_allclose(layer["mean"], 0.99 * before["mean"] + 0.01 * mean)
            wanted = 0.99 * before["variance"] + 0.01 * variance
            np.testing.assert_allclose(layer["variance"], wanted)
    np.testing.assert_allclose(td_error, np.max([np.abs(f.q - y) for f in at], axis=0))


def test_only_gradients_differ(rng: np.random.Generator) -> None:
    """Outputs and moved statistics are those of the joint pass; the gradient is another."""
    network = random_state(learner(), rng, "actor").actor
    x, beside = rng.normal(size=(2, 16, 3))
    with jax.enable_x64(True):
        for warm in (False, True):
            joint = jax.jit(batch_renorm.train)(network, np.concatenate([x, beside]), warm)
            halves = jax.jit(batch_renorm.train_beside)(network, x, beside, warm)
            close(halves, joint, rtol=1e-10)

        def now(train: Any, *rows: Any) -> Any:
            return jax.jit(jax.grad(lambda network: train(network, *rows, False)[0][:16].sum()))

        one = now(batch_renorm.train, np.concatenate([x, beside]))(network)
        other = now(batch_renorm.train_beside, x, beside)(network)
        none = jax.jit(jax.grad(lambda b: batch_renorm.train_beside(network, x, b, True)[0].sum()))
        assert not np.any(none(beside))
    assert not np.allclose(one[0]["kernel"], other[0]["kernel"], rtol=1e-3)


# Weights of length 1.


def test_every_hidden_unit_has_weights_of_length_1(rng: np.random.Generator) -> None:
    """From the start and after updates, of critics and actor; heads are free."""
    algorithm = learner(weight_norm=True)
    state = jax.jit(algorithm.init)(KEY)
    for i in range(3):
        for network in (state.actor, state.critic):
            for layer in network[:-1]:
                np.testing.assert_allclose(length(layer, with_bias=True), 1, rtol=1e-6)
            assert np.abs(length(network[-1], with_bias=False) - 1).max() > 0.01
        state = jax.jit(algorithm.update)(state, batches(rng), jax.random.key(i)).state


def test_a_step_is_adams_with_lengths_made_1(rng: np.random.Generator) -> None:
    """The first step from the same weights, then divided by hand."""
    free, normed = learner(), learner(weight_norm=True)
    state = jax.device_get(jax.jit(normed.init)(KEY))
    batch = batches(rng)
    plain, kept = (jax.jit(each.update)(state, batch, KEY).state for each in (free, normed))
    for layer, other in zip(plain.critic, kept.critic, strict=True):
        hidden = layer is not plain.critic[-1]
        by = length(layer, with_bias=True) if hidden else np.ones_like(layer["bias"])
        np.testing.assert_allclose(other["kernel"], layer["kernel"] / by[..., None, :], rtol=1e-5)
        np.testing.assert_allclose(other["bias"], layer["bias"] / by, rtol=1e-5, atol=1e-7)
        for name in ("scale", "offset", "mean", "variance"):
            np.testing.assert_array_equal(other[name], layer[name])


def test_batch_norm_cancels_the_length(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In learning, a network says the same with weights of length 1, but for epsilon."""
    monkeypatch.setattr(batch_renorm, "EPSILON", 1e-15)
    network, x = random_state(learner(), rng, "actor").actor, rng.normal(size=(64, 3))
    with jax.enable_x64(True):
        unit = batch_renorm.unit_length(network)
        assert not np.allclose(unit[0]["kernel"], network[0]["kernel"], rtol=0.1)
        said = [batch_renorm.train(net, x, False)[0] for net in (network, unit)]
    np.testing.assert_allclose(*said, rtol=1e-6, atol=1e-9)
    assert same(unit[-1], network[-1])


# Runs and presets.


OPTIONS: dict[str, Any] = {"weight_norm": True, "next_batch_gradient": False}


def test_nothing_is_nan(runs: Path, nans_raise: None) -> None:
    """A short run with all options, through batch norm and renorm."""
    settings = {**TINY, "critic_hidden": (16, 16), "warmup": 20, "steps": 80, "renorm_after": 30}
    trainer = Trainer("crossq", "probe_envs:Scripted-v0", runs=runs, **settings, **OPTIONS)
    assert run_to_end(trainer).rows()[-1]["step"] == 80


def test_presets() -> None:
    """The options are off in `crossq` and `crossq-small`; the lean ones turn them on."""
    for name in ("crossq", "crossq-small"):
        hyper = resolve(name, "Walker2d-v5").hyper
        assert (hyper.weight_norm, hyper.next_batch_gradient) == (False, True)
    lean, kept = (resolve(n, "Walker2d-v5").hyper for n in ("crossq-lean", "crossq-wn"))
    assert (lean.critic_hidden, lean.weight_norm) == ((256, 256), False)
    assert (kept.critic_hidden, kept.weight_norm) == ((256, 256), True)
    bins = [resolve(n, "Walker2d-v5").hyper.bins for n in ("crossq", "crossq-wn", "crossq-bins")]
    assert bins == [0, 0, 51]
    assert not lean.next_batch_gradient
    assert not kept.next_batch_gradient
    assert kept.renorm_after > 10**8  # plain batch norm for as long as anyone trains


# Bins.


def test_loss_with_bins_is_that_of_the_head(rng: np.random.Generator) -> None:
    """The first update's loss, told from the critics' own outputs in one pass: cross-entropy to
    the target of the lowest critic, summed over critics; each critic has an output per bin.
    """
    algorithm = learner(bins=11)
    state = algorithm.init(jax.random.key(0))
    assert state.critic[-1]["kernel"].shape[-1] == 11
    (batch,) = [jax.tree.map(lambda x: x[0], batches(rng))]
    key = jax.random.key(2)
    _, (loss, td_error) = algorithm.fit_critic(state, batch, key)
    action, log_prob = gaussian.sample(batch_renorm.fold(state.actor), batch.next_observation, key)
    rows = jnp.concatenate(
        [
            jnp.concatenate([batch.observation, batch.action], axis=-1),
            jnp.concatenate([batch.next_observation, action], axis=-1),
        ]
    )
    outputs, _ = mlp.each(partial(batch_renorm.train, warm=False), state.critic, rows)
    now, later = jnp.split(outputs, 2, axis=1)
    bonus = -jnp.exp(state.log_alpha) * log_prob
    target = algorithm.head.target(later, batch.reward, batch.discount, bonus)
    each, error = algorithm.head.loss(now, target)
    np.testing.assert_allclose(loss, (batch.weight * each).mean(axis=1).sum(), rtol=1e-5)
    np.testing.assert_allclose(td_error, error.max(axis=0), rtol=1e-4, atol=1e-6)


def test_bins_in_a_run_are_off_unless_asked_for(runs: Path) -> None:
    """The loop keeps the returns' deviation for such critics, and for no others."""
    settings: dict[str, Any] = {**TINY, "steps": 300, "critic_hidden": (8,), "hidden": (8,)}
    trainer = Trainer("crossq", "Pendulum-v1", runs=runs, bins=11, name="bins", **settings)
    run_to_end(trainer)
    assert trainer.loop.experience.return_scale.sums[0] == 300
    assert trainer.loop.experience.return_scale.deviation > 1
    plain = Trainer("crossq", "Pendulum-v1", runs=runs, **settings)
    assert plain.loop.experience.return_scale is None
    assert "returns" not in plain.loop.parts()
    plain.close()


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"bins": 1}, r"^bins: one bin cannot tell returns apart; 0, or at least 2, got 1$"),
        ({"bins": 51, "replay": "lap"}, r"^bins: cannot be combined with --replay lap.*: 0, got"),
    ],
)
def test_bins_that_cannot_be_are_refused(settings: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError, match=line):
        resolve("crossq", "Pendulum-v1", settings)

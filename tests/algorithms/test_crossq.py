"""CrossQ: batch renorm by its definition, a second CrossQ in NumPy, and what acts."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numeric import (
    KEY,
    SPEC,
    close,
    member,
    perceptron,
    random_batch,
    random_state,
    slopes,
    squashed,
)
from short_runs import TINY, run_to_end

from pacesetter.algorithms import crossq
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.networks import batch_renorm
from pacesetter.policy import Policy, unstack
from pacesetter.training.trainer import Trainer

train, fold = (jax.jit(f) for f in (batch_renorm.train, batch_renorm.fold))


@jax.jit
def renormalize(layer: Any, x: Any, warm: Any) -> tuple[Any, Any]:
    norm = batch_renorm.norm_of(layer, (x.mean(axis=0), x.var(axis=0)), warm)
    return norm(x), norm.moved


def learner(**hyper: Any) -> crossq.CrossQ:
    return crossq.CrossQ(
        SPEC,
        crossq.Hyper(**{"hidden": (5, 4), "critic_hidden": (4, 3), "policy_delay": 1, **hyper}),
    )


def statistics(mean: Any, variance: Any) -> Any:
    return {"mean": np.asarray(mean, np.float32), "variance": np.asarray(variance, np.float32)}


# Batch renorm.


def test_cold_it_is_batch_norm(rng: np.random.Generator) -> None:
    """Each column ends with mean 0 and deviation 1, whatever the running statistics are."""
    x = rng.normal(3, 2, size=(256, 5)).astype(np.float32)
    layer = statistics(np.full(5, 9), np.full(5, 4))
    normed, moved = renormalize(layer, x, False)
    np.testing.assert_allclose(np.mean(normed, axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(np.std(normed, axis=0), 1, atol=1e-3)
    np.testing.assert_allclose(moved["mean"], 0.99 * 9 + 0.01 * x.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(moved["variance"], 0.99 * 4 + 0.01 * x.var(axis=0), rtol=1e-5)


def test_warm_it_is_what_evaluation_does(rng: np.random.Generator) -> None:
    """Within the limits the batch's own statistics cancel: the folded network says the same."""
    network = jax.tree.map(np.float32, random_state(learner(), rng, "actor").actor)
    x = rng.normal(size=(256, 3)).astype(np.float32)
    for _ in range(1200):  # statistics that fit the batch; 0.99^1200 is 6e-6
        _, network = train(network, x, False)
    said, _ = train(network, x * 1.1, True)
    evaluated = perceptron(jax.device_get(fold(network)), x * 1.1)
    np.testing.assert_allclose(said, evaluated, rtol=1e-3, atol=1e-4)
    cold, _ = train(network, x * 1.1, False)
    assert np.abs(cold - said).max() > 1e-2


@pytest.mark.parametrize(("scale", "stretch"), [(100, 3), (0.001, 1 / 3), (2, 2)])
def test_stretch_has_limits(scale: float, stretch: float, rng: np.random.Generator) -> None:
    """The ratio of deviations counts between 1/3 and 3."""
    x = scale * rng.normal(size=(4096, 1)).astype(np.float32)
    x = (x - x.mean()) / x.std() * np.float32(scale)
    normed, _ = renormalize(statistics([0], [1]), x, True)
    cold, _ = renormalize(statistics([0], [1]), x, False)
    np.testing.assert_allclose(normed, stretch * np.asarray(cold), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize(("mean", "shift"), [(100, 5), (-100, -5), (2, 2)])
def test_shift_has_limits(mean: float, shift: float, rng: np.random.Generator) -> None:
    """The distance of means counts up to 5 running deviations."""
    x = rng.normal(size=(4096, 1))
    x = np.float32((x - x.mean()) / x.std() + mean)
    normed, _ = renormalize(statistics([0], [1]), x, True)
    assert float(np.mean(normed)) == pytest.approx(shift, rel=1e-3)


def test_folded_network_normalises_by_running_statistics(rng: np.random.Generator) -> None:
    """Layer by layer in NumPy; and it is a plain network, as policy files hold."""
    network = jax.tree.map(np.float32, random_state(learner(), rng, "actor").actor)
    x = rng.normal(size=(20, 3)).astype(np.float32)
    folded = jax.device_get(fold(network))
    assert {frozenset(layer) for layer in folded} == {frozenset({"kernel", "bias"})}
    np.testing.assert_allclose(perceptron(folded, x), evaluate(network, x), rtol=1e-4, atol=1e-5)


# A second CrossQ.


def evaluate(network: Any, x: Any) -> Any:
    """Outputs by the running statistics."""
    for index, layer in enumerate(network):
        x = np.maximum(x, 0) if index else x
        x = (x - layer["mean"]) / np.sqrt(layer["variance"] + 1e-3)
        x = (x * layer["scale"] + layer["offset"]) @ layer["kernel"] + layer["bias"]
    return x


class Pass:
    """A pass in learning. The correction towards the running statistics is that of `at`, the
    network before the step, since no gradient reaches it.
    """

    def __init__(self, at: Any, x: Any, warm: bool) -> None:
        self.corrections: list[tuple[Any, Any]] = []
        self.moved: list[dict[str, Any]] = []
        for index, layer in enumerate(at):
            x = np.maximum(x, 0) if index else x
            mean, variance = x.mean(axis=0), x.var(axis=0)
            root, running = np.sqrt(variance + 1e-3), np.sqrt(layer["variance"] + 1e-3)
            r = np.clip(root / running, 1 / 3, 3) if warm else 1.0
            d = np.clip((mean - layer["mean"]) / running, -5, 5) if warm else 0.0
            self.corrections.append((r, d))
            self.moved.append(
                {
                    "mean": 0.99 * layer["mean"] + 0.01 * mean,
                    "variance": 0.99 * layer["variance"] + 0.01 * variance,
                }
            )
            x = self._layer(index, layer, x)

    def __call__(self, network: Any, x: Any) -> Any:
        for index, layer in enumerate(network):
            x = self._layer(index, layer, np.maximum(x, 0) if index else x)
        return x

    def _layer(self, index: int, layer: Any, x: Any) -> Any:
        r, d = self.corrections[index]
        x = (x - x.mean(axis=0)) / np.sqrt(x.var(axis=0) + 1e-3) * r + d
        return (x * layer["scale"] + layer["offset"]) @ layer["kernel"] + layer["bias"]


@pytest.mark.parametrize("warm", [False, True])
def test_an_update_equals_a_reference_in_numpy(warm: bool, rng: np.random.Generator) -> None:
    """Gradients off Adam's first moments (of which a step keeps half), statistics, temperature."""
    algorithm = learner(renorm_after=0 if warm else 100)
    with jax.enable_x64(True):
        old = random_state(algorithm, rng, "actor", "critic")
        batches = random_batch(rng, SPEC, 1, 8)
        update = jax.device_get(jax.jit(algorithm.update)(old, batches, KEY))
        critic_key, actor_key = jax.random.split(KEY)
        following, current = (
            np.asarray(jax.random.normal(k, (8, 2))) for k in (critic_key, actor_key)
        )
    new, batch = update.state, member(batches, 0)
    action, log_prob = squashed(evaluate(old.actor, batch.next_observation), following)
    now = np.concatenate([batch.observation, batch.action], axis=1)
    later = np.concatenate([batch.next_observation, action], axis=1)
    joint = np.concatenate([now, later])
    critics = [member(old.critic, i) for i in range(2)]
    passes = [Pass(critic, joint, warm) for critic in critics]
    said = np.array([p(critic, joint)[:, 0] for p, critic in zip(passes, critics, strict=True)])
    y = batch.reward + batch.discount * (said[:, 8:].min(axis=0) - log_prob)  # alpha is 1

    for i, (forward, critic) in enumerate(zip(passes, critics, strict=True)):

        def critic_loss(network: Any, forward: Pass = forward) -> float:
            return float((batch.weight * (forward(network, joint)[:8, 0] - y) ** 2).mean())

        close(member(new.critic_opt_state[0].mu, i), halved(slopes(critic_loss, critic)))
        for layer, moved in zip(member(new.critic, i), forward.moved, strict=True):
            close({name: layer[name] for name in moved}, moved)
    np.testing.assert_allclose(update.td_error[0], np.abs(said[:, :8] - y).max(axis=0))

    forward = Pass(old.actor, batch.observation, warm)

    def actor_loss(network: Any) -> float:
        action, log_prob = squashed(forward(network, batch.observation), current)
        inputs = np.concatenate([batch.observation, action], axis=1)
        values = [evaluate(member(new.critic, i), inputs)[:, 0] for i in range(2)]
        return float((log_prob - np.min(values, axis=0)).mean())

    close(new.actor_opt_state[0].mu, halved(slopes(actor_loss, old.actor)))
    for layer, moved in zip(new.actor, forward.moved, strict=True):
        close({name: layer[name] for name in moved}, moved)
    _, log_prob = squashed(forward(old.actor, batch.observation), current)
    assert new.alpha_opt_state[0].mu == pytest.approx(0.1 * (2 - log_prob.mean()))


def halved(tree: Any) -> Any:
    """Half a gradient, and nothing of the running statistics, which no gradient reaches."""
    return tuple(
        {k: np.zeros_like(v) if k in ("mean", "variance") else v / 2 for k, v in layer.items()}
        for layer in tree
    )


def test_learners_begin_as_they_should() -> None:
    """Twins apart, in each layer; running statistics 0 and 1; alpha 1."""
    state = jax.jit(learner().init)(KEY)
    for layer in state.critic:
        assert np.all(layer["kernel"][0] != layer["kernel"][1])
    for layer in (*state.actor, *state.critic):
        assert not np.any(layer["mean"])
        assert np.all(layer["variance"] == 1)
    assert state.log_alpha == 0


def test_actor_moves_once_in_three(rng: np.random.Generator) -> None:
    """A cycle is three critic steps, then one of the actor and the temperature; no targets."""
    algorithm = learner(policy_delay=3)
    state = jax.jit(algorithm.init)(KEY)
    assert not [name for name in state._fields if "target" in name]
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, 3, 8))
    update = jax.jit(algorithm.update)(state, batch, KEY)
    assert update.td_error.shape == (3, 8)
    counts = [update.state.critic_opt_state, update.state.actor_opt_state]
    assert [int(adam[0].count) for adam in counts] == [3, 1]
    assert (int(update.state.alpha_opt_state[0].count), int(update.state.updates)) == (1, 3)


@pytest.mark.parametrize("delay", [1, 3])
def test_renorm_follows_the_networks_own_updates(delay: int, rng: np.random.Generator) -> None:
    """With `renorm_after` 2 the third update of each network is the first warm, at any delay."""
    batch = jax.tree.map(np.float32, member(random_batch(rng, SPEC, 1, 8), 0))
    never, soon = (learner(renorm_after=n, policy_delay=delay) for n in (10**9, 2))
    state = jax.jit(never.init)(KEY)
    fits = {
        "critic": [jax.jit(each.fit_critic) for each in (never, soon)],
        "actor": [jax.jit(each.fit_actor) for each in (never, soon)],
    }
    made = {"critic": 0, "actor": 0}
    for number, name in enumerate((["critic"] * delay + ["actor"]) * 3):
        cold, other = (fit(state, batch, jax.random.key(number))[0] for fit in fits[name])
        moments = [getattr(one, f"{name}_opt_state")[0].mu for one in (cold, other)]
        pairs = zip(*map(jax.tree.leaves, moments), strict=True)
        equal = [np.array_equal(a, b) for a, b in pairs if np.any(a != 0)]
        assert equal
        assert all(equal) if made[name] < 2 else not any(equal)
        made[name] += 1
        state = cold


def test_learner_uses_no_key_twice(rng: np.random.Generator) -> None:
    algorithm = learner(policy_delay=3)
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, 3, 7))
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), KEY)
        jax.eval_shape(jax.jit(algorithm.update), state, batch, KEY)


def test_nothing_is_nan(runs: Path, nans_raise: None) -> None:
    """A short run, from an empty replay through batch norm and renorm."""
    settings = {**TINY, "critic_hidden": (16, 16), "warmup": 20, "steps": 80, "renorm_after": 30}
    trainer = Trainer("crossq", "probe_envs:Scripted-v0", runs=runs, **settings)
    assert run_to_end(trainer).rows()[-1]["step"] == 80
    assert trainer.loop.learners.states[0].updates == 60


# What acts, and the presets.


def test_policy_and_acting_are_plain_networks(rng: np.random.Generator) -> None:
    """The file's action is tanh of the evaluated mean; exploration adds its Gaussian."""
    algorithm = learner()
    state = jax.tree.map(np.float32, random_state(algorithm, rng, "actor"))
    observation = rng.normal(size=(20, 3)).astype(np.float32)
    mean, log_std = np.split(evaluate(state.actor, observation), 2, axis=1)
    actors, box = algorithm.policy(state), np.ones(2, np.float32)
    policy = Policy(unstack(actors.layers), actors.activation, actors.output, -box, box)
    np.testing.assert_allclose(policy(observation), np.tanh(mean), atol=1e-5)
    params = jax.device_get(jax.jit(algorithm.policy_params)(state))
    noise = np.random.default_rng(1).standard_normal(2, np.float32)
    action, _ = algorithm.act(params, (), observation[0], np.random.default_rng(1))
    wanted = np.tanh(mean[0] + np.exp(np.clip(log_std[0], -20, 2)) * noise)
    np.testing.assert_allclose(action, wanted, atol=1e-5)


@pytest.mark.parametrize(("name", "width"), [("crossq", 2048), ("crossq-small", 256)])
def test_presets(name: str, width: int) -> None:
    """The paper's critics are 2048 wide, the small ones as wide as the actor."""
    hyper = resolve(name, "Walker2d-v5").hyper
    assert (hyper.hidden, hyper.critic_hidden) == ((256, 256), (width, width))
    assert (hyper.policy_delay, hyper.adam_momentum, hyper.warmup) == (3, 0.5, 5000)
    state = jax.eval_shape(crossq.CrossQ(SPEC, hyper).init, KEY)
    shapes = [layer["kernel"].shape for layer in state.critic]
    assert shapes == [(2, 5, width), (2, width, width), (2, width, 1)]


def test_renorm_after_is_compared_with_a_counter_of_32_bits() -> None:
    assert renormed(2**31 - 1) == 2**31 - 1
    with pytest.raises(UsageError, match="renorm_after"):
        renormed(2**31)


def renormed(after: int) -> int:
    settings: Any = resolve("crossq", "Pendulum-v1", {"renorm_after": after})
    return settings.hyper.renorm_after

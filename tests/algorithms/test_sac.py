"""SAC: golden numbers, a second SAC in NumPy with derivatives by differences, and what acts."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numeric import (
    KEY,
    SPEC,
    close,
    member,
    perceptron,
    quantile_loss,
    random_batch,
    random_state,
    slopes,
    squashed,
)
from short_runs import TINY, run_to_end

from pacesetter.algorithms import sac
from pacesetter.networks import gaussian, mlp
from pacesetter.policy import Policy, unstack
from pacesetter.training.trainer import Trainer

NETWORKS = ("actor", "critic", "target_critic")


def learner(**hyper: Any) -> sac.SAC:
    return sac.SAC(SPEC, sac.Hyper(**{"hidden": (5, 4), **hyper}))


# The squashed Gaussian.


def test_log_probability_is_the_golden_one() -> None:
    """mu 0, std 1, u .5: -.8037095, by three formulas."""
    found = gaussian.log_probability(jnp.array([0.5]), jnp.array([0.5]), jnp.zeros(1))
    assert float(found) == pytest.approx(-0.8037095, abs=1e-6)
    _, by_cosh = squashed(np.zeros(2), np.array([0.5]))
    assert float(by_cosh) == pytest.approx(-0.8037095, abs=1e-7)
    plain = -0.5 * 0.5**2 - 0.5 * np.log(2 * np.pi) - np.log(1 - np.tanh(0.5) ** 2)
    assert plain == pytest.approx(-0.8037095, abs=1e-7)


def test_density_integrates_to_one() -> None:
    """Over the actions in (-1, 1), for a mean and deviation of its own."""
    action = np.linspace(-1, 1, 200_001)[1:-1]
    with jax.enable_x64(True):
        before, log_std = np.arctanh(action), np.log(0.7)
        noise = (before - 0.3) / 0.7
        log_prob = gaussian.log_probability(before[:, None], noise[:, None], np.array([log_std]))
    assert float(np.trapezoid(np.exp(log_prob), action)) == pytest.approx(1, abs=1e-6)


def test_log_probability_is_finite_where_tanh_saturates() -> None:
    """At u = +-50 the action is +-1 to the last bit, whose density the plain formula loses."""
    before = jnp.array([[50.0], [-50.0]])
    found = gaussian.log_probability(before, jnp.zeros((2, 1)), jnp.zeros(1))
    np.testing.assert_allclose(found, 100 - 2 * np.log(2) - 0.5 * np.log(2 * np.pi), rtol=1e-6)


@pytest.mark.parametrize(("said", "used"), [(-1.0, -1.0), (5.0, 2.0), (-30.0, -20.0)])
def test_deviation_is_cut(said: float, used: float) -> None:
    """e^-20 at least and e^2 at most, in what learns and in what acts."""
    actor = ({"kernel": np.zeros((3, 2), np.float32), "bias": np.float32([0, said])},)
    expected = np.tanh(np.exp(used) * np.random.default_rng(0).standard_normal(1, np.float32))
    acted = gaussian.explore(actor, np.zeros(3, np.float32), np.random.default_rng(0))
    np.testing.assert_allclose(acted, expected, rtol=1e-6)
    action, _ = gaussian.sample(actor, np.zeros((1, 3), np.float32), KEY)
    noise = jax.random.normal(KEY, (1, 1))
    np.testing.assert_allclose(action, np.tanh(np.exp(used) * noise), rtol=1e-5)


# A second SAC.


class Reference:
    """SAC's losses in NumPy, for given noise of the next and of the current actions."""

    def __init__(self, algorithm: sac.SAC, batch: Any, key: Any) -> None:
        self.quantiles, self.batch = algorithm.hyper.quantiles, batch
        shape, target_key, actor_key = batch.action.shape, *jax.random.split(key)
        self.following, self.current = (
            np.asarray(jax.random.normal(k, shape)) for k in (target_key, actor_key)
        )

    def target(self, state: Any) -> Any:
        """y (B, 1) or (B, M): of each row the twin with the lower mean."""
        b, (action, log_prob) = self.batch, self._act(state.actor, "next_observation")
        said = np.array([self._say(member(state.target_critic, i), action, True) for i in (0, 1)])
        lower = said.mean(axis=-1).argmin(axis=0)
        least = said[lower, np.arange(len(lower))]
        soft = least - np.exp(state.log_alpha) * log_prob[:, None]
        return b.reward[:, None] + b.discount[:, None] * soft

    def critic_loss(self, y: Any, critic: Any) -> float:
        said = self._say(critic, self.batch.action)
        if not self.quantiles:
            return float((self.batch.weight * (said - y)[:, 0] ** 2).mean())
        rows = [quantile_loss(*pair) for pair in zip(said, y, strict=True)]
        return float((self.batch.weight * rows).mean())

    def actor_loss(self, state: Any, actor: Any) -> float:
        action, log_prob = self._act(actor, "observation")
        values = [self._say(member(state.critic, i), action).mean(axis=-1) for i in (0, 1)]
        return float((np.exp(state.log_alpha) * log_prob - np.min(values, axis=0)).mean())

    def entropy(self, actor: Any) -> float:
        return -float(self._act(actor, "observation")[1].mean())

    def _act(self, actor: Any, of: str) -> tuple[Any, Any]:
        noise = self.following if of == "next_observation" else self.current
        return squashed(perceptron(actor, getattr(self.batch, of)), noise)

    def _say(self, critic: Any, action: Any, following: bool = False) -> Any:
        observation = self.batch.next_observation if following else self.batch.observation
        return perceptron(critic, np.concatenate([observation, action], axis=1))


CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "layer-norm": {"critic_layer_norm": True, "actor_layer_norm": True},
    "quantiles": {"quantiles": 3},
    "entropy": {"target_entropy": 3.0, "initial_alpha": 0.2},
}


@pytest.mark.parametrize("case", CASES)
def test_an_update_equals_a_reference_in_numpy(case: str, rng: np.random.Generator) -> None:
    """Every gradient, read off Adam's first moments, the soft targets, the temperature, errors."""
    algorithm = learner(**CASES[case])
    hyper = algorithm.hyper
    with jax.enable_x64(True):
        old = random_state(algorithm, rng, *NETWORKS)
        batch = random_batch(rng, SPEC, 1, 7)
        update = jax.device_get(jax.jit(algorithm.update)(old, batch, KEY))
        reference = Reference(algorithm, member(batch, 0), KEY)
    new, y = update.state, reference.target(old)
    losses, errors = [], []
    for i in range(2):
        critic = member(old.critic, i)
        loss = partial(reference.critic_loss, y)
        close(member(new.critic_opt_state[0].mu, i), scaled(slopes(loss, critic), 0.1))
        losses.append(loss(critic))
        values = reference._say(critic, reference.batch.action).mean(axis=-1)
        errors.append(np.abs(values - y.mean(axis=-1)))
    assert update.losses["critic_loss"] == pytest.approx(sum(losses))
    np.testing.assert_allclose(update.td_error[0], np.max(errors, axis=0))
    moved = old._replace(critic=new.critic)
    actor_loss = partial(reference.actor_loss, moved)
    close(new.actor_opt_state[0].mu, scaled(slopes(actor_loss, old.actor), 0.1))
    assert update.losses["actor_loss"] == pytest.approx(actor_loss(old.actor))
    for part in ("actor", "critic"):  # the first Adam step is the rate in the gradient's direction
        rate = getattr(hyper, f"{part}_learning_rate")
        moments = getattr(new, f"{part}_opt_state")[0].mu
        stepped = jax.tree.map(
            lambda x, m, r=rate: x - r * m / (np.abs(m) + 1e-9), getattr(old, part), moments
        )
        close(getattr(new, part), stepped)
    soft = jax.tree.map(lambda t, x: 0.995 * t + 0.005 * x, old.target_critic, new.critic)
    close(new.target_critic, soft)
    wanted = -2 if hyper.target_entropy is None else hyper.target_entropy
    excess = reference.entropy(old.actor) - wanted
    assert new.alpha_opt_state[0].mu == pytest.approx(0.1 * excess)
    assert new.log_alpha == pytest.approx(old.log_alpha - 3e-4 * np.sign(excess))
    assert update.losses["alpha"] == pytest.approx(hyper.initial_alpha)
    assert new.updates == 1


def scaled(tree: Any, factor: float) -> Any:
    return jax.tree.map(lambda x: factor * x, tree)


@pytest.mark.parametrize(("wanted", "sign"), [(50.0, 1), (-50.0, -1)])
def test_temperature_follows_the_entropy(wanted: float, sign: int, rng: Any) -> None:
    """Up where entropy is below what is wanted, down where it is above: 100 steps of about 3e-4."""
    algorithm = learner(target_entropy=wanted)
    state = jax.jit(algorithm.init)(KEY)
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, 1, 7))
    step = jax.jit(algorithm.update)
    for i in range(100):
        state = step(state, batch, jax.random.key(i)).state
    assert float(state.log_alpha) == pytest.approx(sign * 0.03, rel=0.02)


def test_learners_begin_as_they_should() -> None:
    """Twins apart, targets as copies, alpha 1."""
    state = jax.jit(learner().init)(KEY)
    close(state.target_critic, state.critic, rtol=0, atol=0)
    for layer in state.critic:
        assert np.all(layer["kernel"][0] != layer["kernel"][1])
    assert state.log_alpha == 0
    assert state.actor[-1]["kernel"].shape == (4, 4)


def test_a_learner_uses_no_key_twice(rng: np.random.Generator) -> None:
    algorithm = learner()
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, 1, 7))
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), KEY)
        jax.eval_shape(jax.jit(algorithm.update), state, batch, KEY)


def test_nothing_is_nan(runs: Path, nans_raise: None) -> None:
    """A short run, from an empty replay through selections of two members."""
    settings = {**TINY, "warmup": 20, "steps": 80}
    trainer = Trainer("multi-sac", "probe_envs:Scripted-v0", runs=runs, **settings)
    assert run_to_end(trainer).rows()[-1]["step"] == 80
    assert all(state.updates >= 20 for state in trainer.loop.learners.states)


# What acts.


def test_exploring_action_is_the_learners_own(rng: np.random.Generator) -> None:
    """In NumPy, the same tanh Gaussian that the learner draws from in JAX; fresh at each step."""
    algorithm = learner(actor_layer_norm=True)
    state = jax.tree.map(np.float32, random_state(algorithm, rng, "actor"))
    observation = rng.normal(size=3).astype(np.float32)
    mean, log_std = np.split(np.asarray(mlp.apply(state.actor, observation)), 2)
    ours, theirs = np.random.default_rng(5), np.random.default_rng(5)
    noise_state = algorithm.start_episode(state.actor, ours)
    for _ in range(3):
        action, noise_state = algorithm.act(state.actor, noise_state, observation, ours)
        noise = theirs.standard_normal(2, np.float32)
        np.testing.assert_allclose(action, np.tanh(mean + np.exp(log_std) * noise), atol=1e-5)


def test_policy_is_the_mean(rng: np.random.Generator) -> None:
    """Without noise the action is tanh of the mean; deviations are not in the file."""
    algorithm = learner()
    state = jax.tree.map(np.float32, random_state(algorithm, rng, "actor"))
    actors = algorithm.policy(state)
    box = np.ones(2, np.float32)
    policy = Policy(unstack(actors.layers), actors.activation, actors.output, -box, box)
    observation = rng.normal(size=(20, 3)).astype(np.float32)
    expected = np.tanh(perceptron(state.actor, observation)[:, :2])
    np.testing.assert_allclose(policy(observation), expected, atol=1e-6)
    assert policy.actors[0][-1]["kernel"].shape == (4, 2)

"""STEVE: golden targets and weights, what it is without a model, and with a perfect one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import NETWORKS, fresh, learner
from numeric import KEY, SPEC, random_batch, same, single
from short_runs import TINY, run_to_end

from pacesetter.algorithms.steve import STEVE, combine, deal
from pacesetter.algorithms.steve_td3 import SteveTD3
from pacesetter.algorithms.td3 import State
from pacesetter.batch import Batch
from pacesetter.config import resolve
from pacesetter.dynamics.model import Dynamics, Known
from pacesetter.ensemble.copying import copy_from_parents
from pacesetter.errors import UsageError
from pacesetter.networks.forward import forward
from pacesetter.training.trainer import Trainer

SMALL: dict[str, Any] = {"hidden": (12, 10), "model_hidden": (8,), "head_hidden": (6,)}


def rows(*shape: int, seed: int = 0) -> Batch:
    """Random transitions, a fifth of them terminal, with uneven weights."""
    return single(random_batch(np.random.default_rng(seed), SPEC, *shape))


def compiled(method: Callable[..., Any]) -> Callable[..., Any]:
    inner = jax.jit(method)
    return lambda *arguments: jax.device_get(inner(*arguments))


# Targets by hand.


class Script:
    """A model whose observation counts its steps, and which pays and ends as told."""

    def predict(self, models: Any, observation: Any, action: Any) -> tuple[Any, None]:
        return observation + 1, None

    def reward(self, models: Any, observation: Any, action: Any, following: Any) -> Any:
        return said((1, 0.5, 0.25), following)[None]

    def terminated(self, models: Any, observation: Any, action: Any, following: Any) -> Any:
        return said((0, 0.2, 0.5), following)


class Scripted(SteveTD3):
    """Its two pairs of twins say of a step what the script says, or more."""

    dynamics = cast(Any, Script())

    def next_action(self, state: Any, observation: Any, key: Any) -> Any:
        return jnp.zeros((len(observation), 2))

    def values(self, critic: Any, observation: Any, action: Any) -> Any:
        value = said((10, 9, 8), observation)
        return jnp.stack([value, value + 1, value + 2, value])


class Nothing(NamedTuple):
    target_critic: None = None
    models: None = None


def said(script: tuple[float, ...], observation: Any) -> Any:
    return jnp.array(script, jnp.float32)[observation[..., 0].astype(int)]


def scripted(discount: float) -> list[Any]:
    hyper = SteveTD3.Hyper(horizon=2, models=2, batch_size=4, **SMALL)
    algorithm = Scripted(SPEC, hyper)
    batch = rows(4)._replace(
        next_observation=np.zeros((4, 3), np.float32),
        reward=np.ones(4, np.float32),
        discount=np.full(4, discount, np.float32),
    )
    return [np.asarray(x) for x in algorithm.candidates(cast(Any, Nothing()), batch, KEY)]


def test_targets_of_each_horizon_by_hand() -> None:
    """r = (1, .5, .25), ends (0, .2, .5), values (10, 9, 8), gamma .99; the first end is real."""
    found = scripted(0.99)
    assert [len(each) for each in found] == [2, 4, 4]  # 2 members; times 2 models and 1 head
    for each, expected in zip(found, (10.9, 8.55172, 4.7959768), strict=True):
        np.testing.assert_allclose(each, np.full(each.shape, expected), rtol=1e-6)


def test_nothing_is_imagined_after_a_real_end() -> None:
    """All candidates are the reward, whatever the model says."""
    assert all(np.all(each == 1) for each in scripted(0.0))


def test_weights_by_hand() -> None:
    """Values {1, 3}, {2, 2.2}, {0, 4}: population variances 1, .01, 4."""
    candidates = [np.float32([[1], [3]]), np.float32([[2], [2.2]]), np.float32([[0], [4]])]
    y, weight = combine(candidates)
    np.testing.assert_allclose(weight[:, 0], [0.009877, 0.987654, 0.002469], atol=1e-6)
    np.testing.assert_allclose(y, [2.098765], atol=1e-5)


# A perfect model.


def test_a_perfect_linear_model_gives_the_n_step_return() -> None:
    """Candidates of a real ensemble of linear networks against the task stepped in NumPy."""
    gamma, horizon = 0.9, 3
    rng = np.random.default_rng(2)
    change = (0.3 * rng.normal(size=(5, 3))).astype(np.float32)
    known = Known(lambda s, a, t: s[..., 0] - a[..., 1] + 2 * t[..., 2], lambda t: t[..., 1] > 0.8)
    algorithm = learner("steve", gamma=gamma, horizon=horizon, batch_size=32, **SMALL)
    perfect = Dynamics(SPEC, members=4, hidden=(), known=known)

    class Perfect(STEVE):
        dynamics = perfect

    algorithm = Perfect(algorithm.spec, algorithm.hyper)
    state = fresh(algorithm, 3)
    layer = {"kernel": np.stack([change] * 4), "bias": np.zeros((4, 3), np.float32)}
    networks = state.models.networks._replace(change=(layer,))
    state = state._replace(models=state.models._replace(networks=networks))
    batch = rows(32)
    batch = batch._replace(discount=np.where(batch.discount > 0, gamma, 0).astype(np.float32))
    found = compiled(algorithm.candidates)(state, batch, KEY)
    assert [each.shape for each in found] == [(4, 32)] + 3 * [(16, 32)]

    observation, total, factor = batch.next_observation, batch.reward, batch.discount
    ends = 0
    for each in found:
        action, value = jax.device_get(algorithm.ask(state, observation, KEY))
        expected = total + factor * value  # (L, B), for every model
        got = each.reshape(4, -1, 32)
        np.testing.assert_allclose(got, np.broadcast_to(expected[:, None], got.shape), atol=1e-5)
        following = observation + np.concatenate([observation, action], axis=1) @ change
        total = total + factor * known.reward(observation, action, following)
        ended = following[:, 1] > 0.8
        ends += np.sum(ended & (factor > 0))
        factor, observation = factor * gamma * ~ended, following
    assert 3 < ends < 30


# Without a model.


def assert_equal_networks(ours: Any, theirs: Any) -> None:
    for part in (*NETWORKS, "actor_opt_state", "critic_opt_state", "updates"):
        assert same(getattr(ours, part), getattr(theirs, part)), part


@pytest.mark.parametrize(("name", "base"), [("steve", "ddpg"), ("steve-td3", "td3")])
def test_without_horizon_it_is_its_base(name: str, base: str) -> None:
    """One critic member, horizon 0: the same bits in all networks and moments after 5 cycles."""
    steve = learner(name, horizon=0, critic_members=1, batch_size=16, **SMALL)
    plain = learner(base, batch_size=16, hidden=SMALL["hidden"])  # acts otherwise, learns alike
    update, plain_update = compiled(steve.update), compiled(plain.update)
    ours = fresh(steve, 3)
    theirs = State(**{part: getattr(ours, part) for part in State._fields})
    for cycle in range(5):
        batch, key = rows(plain.updates_per_call, 16, seed=cycle), jax.random.key(cycle)
        mine, other = update(ours, batch, key), plain_update(theirs, batch, key)
        ours, theirs = mine.state, other.state
        assert_equal_networks(ours, theirs)
        assert same(mine.td_error, other.td_error)
        assert mine.losses["model_use"] == 0
        assert "model_loss" not in mine.losses
    assert same(ours.models, fresh(steve, 3).models)  # which nothing asks
    assert steve.ledger([], 10, 0) == {"model_updates": 0, "imagined_transitions": 0}


@pytest.mark.slow
def test_a_whole_run_without_horizon_is_td3(runs: Path) -> None:
    """Env, noise, replay and evaluation included."""
    settings = {**TINY, "steps": 400, "eval_every": 200}
    plain = Trainer("td3", "Hopper-v5", runs=runs, **settings)
    settings |= {"horizon": 0, "critic_members": 1, "model_hidden": (8,), "head_hidden": (6,)}
    steve = Trainer("steve-td3", "Hopper-v5", runs=runs, **settings)
    scores = [
        [row["returns"] for row in run_to_end(trainer).rows() if row["kind"] == "eval"]
        for trainer in (steve, plain)
    ]
    assert scores[0] == scores[1]
    assert_equal_networks(steve.loop.learners.states[0], plain.loop.learners.states[0])


def test_several_members_without_horizon_share_the_mean_target() -> None:
    """Each member is a pair of twins whose minimum counts; the actor climbs the first twins."""
    algorithm = learner("steve-td3", horizon=0, critic_members=3, batch_size=16, **SMALL)
    state, batch = fresh(algorithm, 3), rows(16)
    y, weight = compiled(algorithm.expanded_target)(state, batch, KEY)
    action = compiled(algorithm.next_action)(state, batch.next_observation, KEY)
    values = compiled(algorithm.values)(state.target_critic, batch.next_observation, action)
    expected = np.asarray(values).reshape(3, 2, 16).min(axis=1).mean(axis=0)
    np.testing.assert_allclose(y, batch.reward + batch.discount * expected, atol=1e-6)
    assert np.all(weight == 1)
    climbed = compiled(algorithm.actor_value)(state.target_critic, batch.next_observation, action)
    np.testing.assert_allclose(climbed, np.asarray(values)[::2].mean(axis=0), atol=1e-6)


# Who learns from what.


@pytest.fixture(scope="module")
def steve() -> tuple[Any, Any, Callable[..., Any]]:
    algorithm = learner("steve", horizon=2, critic_members=2, models=3, batch_size=16, **SMALL)
    return algorithm, fresh(algorithm, 3), compiled(algorithm.update)


def test_each_model_and_critic_learns_from_rows_of_its_own(
    steve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other rewards in row 1 change model 1 and critic 1 alone, once targets are given."""
    algorithm, state, _ = steve
    batch, other = rows(16), rows(16)
    other.reward[1] += 100  # so that signs of gradients change, which is all a first Adam step sees
    monkeypatch.setattr(Dynamics, "observe", lambda self, models, batch: models)  # is for all
    fit = compiled(algorithm.fit_models)
    one, two = fit(state, batch)[0].models, fit(state, other)[0].models
    for index, moved in ((0, False), (1, True), (2, False)):
        networks = [jax.tree.map(lambda x, i=index: x[i], m.networks) for m in (one, two)]
        assert same(*networks) != moved
    routes = np.asarray(algorithm.routes(16))
    np.testing.assert_array_equal(routes, [[2, 0] * 8, [0, 2] * 8])  # means of its own rows
    fit_critic = compiled(algorithm.fit_critic)
    one, two = (
        fit_critic(state, batch, x.reward, batch.weight * routes)[0].critic for x in (batch, other)
    )
    for index, moved in ((0, False), (1, True)):
        assert same(*[jax.tree.map(lambda x, i=index: x[i], c) for c in (one, two)]) != moved


@pytest.mark.parametrize(("name", "twins"), [("steve", 1), ("steve-td3", 2)])
def test_a_critic_step_leaves_the_rows_of_others_out(name: str, twins: int) -> None:
    """Other rewards in row 1 change member 1 alone, and those in row 0 member 0."""
    algorithm = learner(name, horizon=0, critic_members=2, batch_size=16, **SMALL)
    state, step = fresh(algorithm, 3), compiled(algorithm.critic_step)
    plain = step(state, rows(16), KEY)[0].critic
    for row in (0, 1):
        other = rows(16)
        other.reward[row] += 100
        critic = step(state, other, KEY)[0].critic
        for index in range(2 * twins):
            pair = [jax.tree.map(lambda x, i=index: x[i], c) for c in (plain, critic)]
            assert same(*pair) == (index // twins != row)


@pytest.mark.parametrize("name", ["steve", "steve-td3"])
def test_models_learn_as_the_settings_say(name: str) -> None:
    """Their rate and decay reach the dynamics, whose step is proved elsewhere."""
    told = learner(name, model_learning_rate=0.02, model_decay=0.3, batch_size=16, **SMALL)
    assert (told.dynamics.learning_rate, told.dynamics.decay) == (0.02, 0.3)


def test_every_row_is_dealt_to_a_model() -> None:
    """Also where they do not divide a minibatch: each model's weighted mean is that of its rows."""
    batch = rows(8)
    for count in (1, 3, 4, 8):
        hands = jax.device_get(deal(batch, count))
        means = (hands.weight * hands.reward).mean(axis=1)
        parts = [slice(model, None, count) for model in range(count)]
        expected = [(batch.weight[own] * batch.reward[own]).mean() for own in parts]
        np.testing.assert_allclose(means, expected, rtol=1e-6)


def test_pairs_of_twins_share_their_rows() -> None:
    algorithm = learner("steve-td3", batch_size=4, **SMALL)
    expected = [[2, 0, 2, 0]] * 2 + [[0, 2, 0, 2]] * 2
    np.testing.assert_array_equal(algorithm.routes(4), expected)


@pytest.mark.slow
def test_model_use_is_what_horizon_0_does_not_get(steve: Any) -> None:
    """One minus its weight, which lies strictly between 0 and 1 as soon as both can vary."""
    algorithm, state, update = steve
    found = update(state, rows(1, 16), KEY)
    assert 0 < found.losses["model_use"] < 1
    fitted, _ = jax.device_get(
        jax.jit(algorithm.fit_models)(state, jax.tree.map(first, rows(1, 16)))
    )
    step_key, _ = jax.random.split(KEY)
    _, weight = compiled(algorithm.expanded_target)(
        fitted, jax.tree.map(first, rows(1, 16)), step_key
    )
    np.testing.assert_allclose(weight.sum(axis=0), 1, rtol=1e-5)
    np.testing.assert_allclose(found.losses["model_use"], 1 - weight[0].mean(), rtol=1e-3)
    ledger = algorithm.ledger([], 10, 99)
    assert ledger == {"model_updates": 10, "imagined_transitions": 10 * 16 * 3 * 2}


def first(x: Any) -> Any:
    return x[0]


def test_no_gradient_flows_through_the_target(steve: Any) -> None:
    algorithm, state, _ = steve
    batch = rows(16)

    def total(critic: Any, actor: Any, networks: Any) -> Any:
        models = state.models._replace(networks=networks)
        changed = state._replace(target_critic=critic, target_actor=actor, models=models)
        return algorithm.expanded_target(changed, batch, KEY)[0].sum()

    slope = jax.jit(jax.grad(total, (0, 1, 2)))
    gradient = slope(state.target_critic, state.target_actor, state.models.networks)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("copy", ["full", "weights", "actor"])
def test_copies_of_members(copy: str) -> None:
    """Models go with the networks; `weights` leaves each its own moments, `actor` its models."""
    algorithm = learner("steve", batch_size=16, **SMALL)
    states = [fresh(algorithm, seed) for seed in (0, 1)]
    states[1] = states[1]._replace(
        models_opt_state=jax.tree.map(lambda x: x + 1, states[1].models_opt_state)
    )
    _, copied = copy_from_parents(algorithm, states, np.array([0, 0]), copy)
    assert same(copied.actor, states[0].actor)
    assert same(copied.models, states[1 if copy == "actor" else 0].models)
    own = states[0 if copy == "full" else 1].models_opt_state
    assert same(copied.models_opt_state, own)


def test_no_key_is_used_twice() -> None:
    algorithm = learner("steve-td3", batch_size=16, **SMALL)
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), KEY)
        jax.eval_shape(jax.jit(algorithm.update), state, rows(2, 16), KEY)


@pytest.mark.slow
def test_nothing_is_nan(runs: Path, nans_raise: None) -> None:
    """A short run, from an empty replay through selections of two members."""
    settings = {**TINY, "warmup": 20, "steps": 80, "model_hidden": (8,), "head_hidden": (6,)}
    trainer = Trainer("multi-steve-td3", "probe_envs:Scripted-v0", runs=runs, **settings)
    last = run_to_end(trainer).rows()[-1]
    assert (last["step"], last["model_updates"]) == (80, last["updates"])


# Exploration and settings.


def test_sparse_exploration_is_the_published_one() -> None:
    """Each number, with probability .05 and alone, gets normal noise before the tanh."""
    algorithm = learner("steve", **SMALL)
    params = fresh(algorithm, 3).actor, ()
    rng, observation = np.random.default_rng(1), np.float32([0.1, -0.2, 0.3])
    before = forward(params[0], observation)
    actions = np.array([algorithm.act(params, (), observation, rng)[0] for _ in range(20_000)])
    noise = np.arctanh(actions) - before
    changed = np.abs(noise) > 1e-5
    assert np.all(np.abs(changed.mean(axis=0) - 0.05) < 5 * (0.05 * 0.95 / 20_000) ** 0.5)
    assert abs(np.mean(changed.all(axis=1)) - 0.05**2) < 5 * 0.05 / 20_000**0.5
    assert abs(noise[changed].std() - 1) < 5 / (2 * changed.sum()) ** 0.5


def test_parameter_noise_adapts() -> None:
    """As in TD3: by 1% at the 50th update, here up, since no actions are as far apart as 10."""
    noisy = {"exploration": "parameter", "actor_layer_norm": True, "exploration_noise": 10}
    algorithm = learner("steve-td3", batch_size=8, **noisy, **SMALL)
    update, sigma = compiled(algorithm.update), np.float32(0.2)
    for made, factor in ((46, 1), (48, 1.01)):
        state = fresh(algorithm, 3)._replace(updates=np.int32(made), exploration=sigma)
        found = update(state, rows(2, 8), KEY)
        assert found.state.exploration == found.losses["sigma"]
        np.testing.assert_allclose(found.losses["sigma"], sigma * factor, rtol=1e-6)


def test_settings_that_cannot_work_are_refused() -> None:
    for name, settings, message in (
        ("steve", {"critic_members": 1}, "critic_members: gives the models no weight"),
        ("steve-td3", {"critic_members": 1}, "critic_members: gives the models no weight"),
        ("steve", {"batch_size": 3, "critic_members": 2}, "models: is more than there are rows"),
        ("steve-td3", {"quantiles": 25}, "quantiles: is fixed"),
        ("steve", {"quantiles": 25}, "quantiles: is fixed"),
        ("steve", {"n_step": 3}, "n_step: is fixed"),
        ("steve-td3", {"n_step": 3}, "n_step: is fixed"),
        ("steve", {"policy_delay": 2}, "policy_delay: is fixed"),
    ):
        with pytest.raises(UsageError, match=message):
            resolve(name, "Hopper-v5", settings)
    assert resolve("steve-td3", "Hopper-v5", {"horizon": 0, "critic_members": 1}).hyper.horizon == 0

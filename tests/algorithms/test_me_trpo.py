"""ME-TRPO: imagined steps, the rule that ends a search, and the rounds that feed it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numeric import same
from scipy.stats import chisquare
from short_runs import assert_same, log, run_to_end
from stopping import kill_and_resume, only_run, stop_at

from pacesetter import config
from pacesetter.algorithms import me_trpo, trpo
from pacesetter.batch import Batch, Layout, Spec
from pacesetter.cli.main import main
from pacesetter.config import resolve
from pacesetter.dynamics.model import Dynamics, Known, Models
from pacesetter.errors import UsageError
from pacesetter.learner.compiled import UpdateInputs
from pacesetter.networks import trust_region
from pacesetter.replay import buffer
from pacesetter.training.trainer import Trainer

SMALL: dict[str, Any] = {
    "hidden": (8,),
    "models": 2,
    "model_hidden": (16,),
    "model_batch_size": 64,
    "model_rows": 3_000,
    "imagined_steps": 200,
    "horizon": 20,
    "policy_updates": 4,
    "check_every": 2,
    "patience": 4,
    "starts": 5,
    "critic_epochs": 2,
    "critic_batch_size": 100,
    "rollout_length": 250,
}
RUN: dict[str, Any] = {**SMALL, "eval_episodes": 1, "eval_every": 500, "checkpoint_every": 3600}

# A cart: it moves by a tenth of the action, pays its place, and ends where that is above 1.
CART = Known(lambda s, a, after: after[..., 0], lambda after: after[..., 0] > 1)


class Linear(me_trpo.METRPO):
    """A learner whose models have no hidden layer."""

    @property
    def dynamics(self) -> Dynamics:
        return replace(super().dynamics, hidden=())


def learner(known: Known | None = CART, **settings: Any) -> me_trpo.METRPO:
    return Linear(Spec(1, 1), me_trpo.Hyper(**{**SMALL, **settings}), known)


def linear(algorithm: me_trpo.METRPO, *drifts: float) -> Models:
    """Perfect linear models of the cart, but that member k also drifts by drifts[k] a step."""
    models = algorithm.dynamics.init(jax.random.key(0))
    count = len(drifts)
    kernel = jnp.array([[[0.0], [0.1]]] * count)  # (K, observation and action, change)
    bias = jnp.array(drifts, jnp.float32)[:, None]
    change = ({"kernel": kernel, "bias": bias},)
    scale = models.scale._replace(
        mean=jnp.zeros_like(models.scale.mean), variance=jnp.ones_like(models.scale.variance)
    )
    return models._replace(networks=models.networks._replace(change=change), scale=scale)


def steady(action: float) -> trust_region.Gaussian:
    """A policy whose mean is the same everywhere."""
    network = (
        {"kernel": jnp.zeros((1, 8)), "bias": jnp.zeros(8)},
        {"kernel": jnp.zeros((8, 1)), "bias": jnp.full(1, action)},
    )
    return trust_region.Gaussian(network, jnp.full(1, jnp.log(0.5)))


# Imagined steps.


@pytest.fixture(scope="module")
def cart() -> me_trpo.METRPO:
    return learner(models=3)


def test_returns_of_a_perfect_linear_model(cart: me_trpo.METRPO) -> None:
    """From 0 with action .5, place t is .05 t: 20 steps pay .05 + .1 + ... + 1, which is no end.

    From .5 the 11th step goes beyond 1, is paid, and is the last.
    """
    models, starts = linear(cart, 0, 0, 0), jnp.array([[0.0], [0.52]])
    whole = sum(0.05 * t for t in range(1, 21))
    cut = sum(0.52 + 0.05 * t for t in range(1, 11))
    found = jax.jit(cart.imagined.returns)(models, steady(0.5), starts)
    np.testing.assert_allclose(found, [(whole + cut) / 2] * 3, rtol=1e-4)


def test_returns_are_those_of_each_model_alone(cart: me_trpo.METRPO) -> None:
    models, starts = linear(cart, 0, -0.05, 0.01), jnp.zeros((1, 1))
    found = jax.jit(cart.imagined.returns)(models, steady(0.5), starts)
    np.testing.assert_allclose(found[0], 10.5, rtol=1e-4)
    np.testing.assert_allclose(found[1], 0, atol=1e-4)
    expected = np.cumsum(np.full(20, 0.06))
    np.testing.assert_allclose(found[2], expected[: np.argmax(expected > 1) + 1].sum(), rtol=1e-4)


def test_actions_are_cut_for_the_models(cart: me_trpo.METRPO) -> None:
    models, starts = linear(cart, 0, 0, 0), jnp.full((1, 1), -9.0)
    found = jax.jit(cart.imagined.returns)(models, steady(50.0), starts)
    np.testing.assert_allclose(found, sum(-9 + 0.1 * t for t in range(1, 21)), rtol=1e-4)


def test_imagined_states_stay_near_the_data(cart: me_trpo.METRPO) -> None:
    """Ten deviations, here 10: a model that runs away is held there."""
    models, starts = linear(cart, -3, -3, -3), jnp.zeros((1, 1))
    found = jax.jit(cart.imagined.returns)(models, steady(0.0), starts)
    np.testing.assert_allclose(found, -3 - 6 - 9 - 17 * 10, rtol=1e-5)


def test_imagined_rollout(cart: me_trpo.METRPO) -> None:
    """Each row follows from the one before by one model's step; an end leads to a new start."""
    models, starts = linear(cart, 0, 0, 0), jnp.array([[0.3], [0.7]])
    rows = jax.jit(cart.imagined.rollout)(models, steady(0.5), starts, jax.random.key(1))
    assert rows.observation.shape == (20, 10, 1)
    np.testing.assert_allclose(
        rows.next_observation, rows.observation + 0.1 * jnp.clip(rows.action, -1, 1), atol=1e-5
    )
    assert float(jnp.abs(rows.action).max()) > 1  # stored as drawn
    np.testing.assert_allclose(rows.action.mean(), 0.5, atol=0.1)
    np.testing.assert_allclose(rows.action.std(), 0.5, atol=0.1)
    np.testing.assert_array_equal(rows.reward, rows.next_observation[..., 0])
    ended = np.asarray(rows.next_observation[..., 0] > 1)
    assert 5 < ended.sum() < 100
    np.testing.assert_array_equal(rows.last, ended)
    np.testing.assert_allclose(rows.discount, 0.99 * ~ended, rtol=1e-6)
    before, after = rows.next_observation[:-1, :, 0], np.asarray(rows.observation[1:, :, 0])
    np.testing.assert_array_equal(after[~ended[:-1]], before[~ended[:-1]])
    fresh = [*np.asarray(rows.observation[0, :, 0]), *after[ended[:-1]]]
    assert set(np.round(fresh, 3)) == {np.float32(0.3), np.float32(0.7)}


def test_each_step_draws_its_model(cart: me_trpo.METRPO) -> None:
    """Drifts tell the models apart; over 20 steps of many rollouts each is drawn equally often."""
    models, starts = linear(cart, 0, -1e-2, -2e-2), jnp.zeros((1, 1))
    rollout = jax.jit(cart.imagined.rollout)
    counts = np.zeros(3)
    for i in range(30):
        rows = rollout(models, steady(0.0), starts, jax.random.key(i))
        move = rows.next_observation - rows.observation - 0.1 * jnp.clip(rows.action, -1, 1)
        number = np.asarray(jnp.round(move[..., 0] / -1e-2)).astype(int)
        assert (number == number[:, :1]).all()  # one for all paths of a step
        counts += np.bincount(number[:, 0], minlength=3)
    assert counts.sum() == 600
    assert chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize("bootstrap", [True, False])
def test_horizon_counts_a_value_or_ends_the_task(bootstrap: bool) -> None:
    algorithm = learner(bootstrap=bootstrap)
    models, starts = linear(algorithm, 0, 0), jnp.full((1, 1), -9.0)
    rows = jax.jit(algorithm.imagined.rollout)(models, steady(0.0), starts, jax.random.key(0))
    np.testing.assert_allclose(rows.discount[:-1], 0.99, rtol=1e-6)
    np.testing.assert_allclose(rows.discount[-1], 0.99 * bootstrap, rtol=1e-6)


# The rule that ends a search.


@pytest.mark.parametrize(
    ("worse", "models", "agreed"),
    [
        *((0, 5, True), (1, 5, True), (2, 5, False), (5, 5, False)),
        *((0, 1, True), (1, 1, False), (3, 10, True), (4, 10, False)),
    ],
)
def test_seventy_percent_of_the_models(worse: int, models: int, agreed: bool) -> None:
    """Equal returns are no fall."""
    before = jnp.arange(models, dtype=jnp.float32)
    after = before - (jnp.arange(models) < worse)
    assert bool(me_trpo.agree(after, before, 0.7)) == agreed


class Scripted(me_trpo.METRPO):
    """The actor counts its updates; the models say of each count what a table holds."""

    @property
    def base(self) -> trpo.TRPO:
        return Counting(self.spec, self.hyper)

    @property
    def imagined(self) -> Any:
        return SimpleNamespace(
            rollout=lambda models, actor, starts, key: None,
            returns=lambda models, actor, starts: models[jnp.round(actor.log_std[0]).astype(int)],
        )


class Counting(trpo.TRPO):
    def update(self, state: trpo.State, batch: Any, key: Any) -> Any:
        actor = state.actor._replace(log_std=state.actor.log_std + 1)
        return trpo.Update(state._replace(actor=actor), {}, jnp.zeros(()))


def searched(table: Any, **settings: Any) -> me_trpo.Search:
    fixed = {"policy_updates": 50, "check_every": 5, "patience": 25, "initial_std": 1.0}
    hyper = me_trpo.Hyper(**{**SMALL, **fixed, **settings})
    algorithm = Scripted(Spec(1, 1), hyper)
    start = algorithm.base.init(jax.random.key(0))
    wide = start.actor._replace(log_std=jnp.full(1, 7.0))  # which a search does not go on from
    start = start._replace(actor=wide)
    none: Any = None
    return jax.jit(algorithm.search)(start, jnp.array(table, jnp.float32), none, jax.random.key(0))


def test_search_ends_when_the_models_do_not_agree_and_goes_back() -> None:
    """Checked after 5, 10, ... updates. 5: all better. 10: two of five worse, not kept. 15: one
    worse than at 5, kept, though it was better at 10 in one. Then nothing is kept: ends at 40.
    """
    table = np.full((60, 5), -9.0)
    table[0], table[5] = 0, 1
    table[10], table[15] = [0, 0, 3, 3, 3], [0, 1, 1, 1, 1]
    table[20:41] = [-1, 0, 1, 1, 1]  # of the five, two fell since 15
    found = searched(table)
    assert found.made == 40
    assert found.kept.log_std == 15
    np.testing.assert_array_equal(found.returns, table[15])


def test_search_that_helps_goes_on_to_the_most_updates() -> None:
    table = np.arange(60)[:, None] * np.ones(5)
    assert searched(table).made == searched(table).kept.log_std == 50
    found = searched(table, policy_updates=12)
    assert found.made == found.kept.log_std == 12  # 5, 10 and a short last round


def test_search_that_only_harms_gives_back_the_start() -> None:
    table = -np.arange(60)[:, None] * np.ones(5)
    found = searched(table)
    assert (found.made, found.kept.log_std) == (25, 0)


# An iteration.


class Remembering(me_trpo.METRPO):
    """A search whose last policy is not the one that was kept; each counts from the given one."""

    def search(self, learner: trpo.State, models: Any, starts: Any, key: Any) -> me_trpo.Search:
        def at(log_std: Any) -> trust_region.Gaussian:
            return learner.actor._replace(log_std=log_std)

        now = learner.actor.log_std
        last = learner._replace(actor=at(now + 5))
        return me_trpo.Search(last, at(now + 1), jnp.zeros(2), jnp.array(2), jnp.array(3))


def test_iterations_fit_from_before_or_anew_and_go_on_with_the_policy_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With `renew_every` 2, fits 0 and 2 begin with new networks, 1 and 3 with those fitted last;
    all learn from actions as the env was given them. Each search begins where the last one kept.
    """
    algorithm = Remembering(Spec(1, 1), me_trpo.Hyper(**{**SMALL, "renew_every": 2}), CART)
    fits: list[tuple[Models, Any, Models]] = []

    def fit(dynamics: Any, models: Models, data: Batch, *rest: Any) -> Any:
        moved = jax.tree.map(lambda x: x + 1, models)
        fits.append((models, data.action, moved))
        return SimpleNamespace(models=moved, loss=jnp.zeros(2), epochs=jnp.array(4))

    monkeypatch.setattr(me_trpo, "fit", fit)
    column, action = jnp.zeros((4, 1)), jnp.array([[-3.0], [-0.5], [0.5], [1.5]])
    batch = Batch(
        observation=column, action=action, reward=column[:, 0], next_observation=column,
        discount=column[:, 0], last=column[:, 0], mask=jnp.zeros((4, 0)), starts=column, valid=4,
    )  # fmt: skip
    states = [algorithm.init(jax.random.key(0))]
    for i in range(4):
        states.append(algorithm.update(states[-1], batch, jax.random.key(i)).state)
    for i, (given, seen, _) in enumerate(fits):
        fit_key, _ = jax.random.split(jax.random.key(i))
        new = algorithm.dynamics.init(jax.random.split(fit_key)[0])
        assert same(given, fits[i - 1][2] if i % 2 else new)
        np.testing.assert_array_equal(seen, [[-1], [-0.5], [0.5], [1]])
    assert len(fits) == 4
    start = states[0].learner.actor
    for i, state in enumerate(states):
        assert same(state.learner.actor, start._replace(log_std=start.log_std + i))
        assert [int(n) for n in (state.updates, state.searched, state.fitted)] == [i, 3 * i, 4 * i]
    for state, (_, _, moved) in zip(states[1:], fits, strict=True):
        assert same(state.models, moved)


# Rounds.


def test_models_learn_at_the_rate_of_the_settings() -> None:
    assert learner(model_learning_rate=0.02).dynamics.learning_rate == 0.02


def test_ring_is_given_whole(tmp_path: Path) -> None:
    """Rows at their number modulo the size; what was not written is 0."""
    ring = buffer.Replay(tmp_path / "ring.bin", Layout(Spec(1, 1)), 10, 1_000)
    for n in range(1, 26):
        ring.append(np.full(ring.layout.width, n, np.float32))
        window = ring.padded(10)[:, 0]
        expected = [
            max((m for m in range(n) if m % 10 == place), default=-1) for place in range(10)
        ]
        np.testing.assert_array_equal(window, np.array(expected) + 1)
    ring.close()


def watch(trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The data of each update."""
    compiled: Any = trainer.loop.learners.compiled
    seen: list[Any] = []
    update = compiled.update

    def spy(state: Any, member: int, inputs: UpdateInputs) -> Any:
        seen.append((inputs.rows.copy(), inputs.extra))
        return update(state, member, inputs)

    monkeypatch.setattr(compiled, "update", spy)
    return seen


def test_update_sees_all_steps_and_fresh_starts(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**RUN, "replay_size": 600, "steps": 1_050}
    trainer = Trainer("me-trpo", "Hopper-v5", runs=runs, **settings)
    seen = watch(trainer, monkeypatch)
    last = log(run_to_end(trainer))[-1]
    assert last["step"] == 1_050
    assert last["member_steps"] == [1_050]
    assert (last["updates"], last["resets"]) == (4, 20)
    assert [extra["valid"] for _, extra in seen] == [250, 500, 600, 600]
    assert last["transitions"] == 250 + 500 + 600 + 600
    rows, _ = seen[0]
    assert rows.shape[0] == 600
    assert not rows[250:].any()
    np.testing.assert_array_equal(seen[1][0][:250], rows[:250])
    np.testing.assert_array_equal(seen[2][0][150:500], seen[1][0][150:500])  # 600 on 0 to 149
    starts = np.concatenate([extra["starts"] for _, extra in seen])
    assert starts.shape == (20, 11)
    assert len(np.unique(starts, axis=0)) == 20
    np.testing.assert_allclose(starts[:, 0], 1.25, atol=0.01)  # the hopper's height at a reset


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False], ids=["known", "learned"])
def test_stopped_run_equals_uninterrupted(known: bool, runs: Path) -> None:
    def start(name: str) -> Trainer:
        settings = {**RUN, "steps": 1_100, "replay_size": 600, "known": known, "name": name}
        return Trainer("me-trpo", "HalfCheetah-v5", runs=runs, **settings)

    whole, stopped = run_to_end(start("whole")), start("stopped")
    for tick in (1, 3):
        stop_at(stopped, tick)
        assert stopped.progress.step == 250 * tick
        stopped = Trainer.resume(stopped.directory.path)
        assert stopped.notes == []
    assert_same(whole, run_to_end(stopped))


@pytest.mark.slow
def test_killed_run_equals_undisturbed(tmp_path: Path) -> None:
    words = ["train", "me-trpo", "Hopper-v5", "--steps", "8000", "--eval-episodes", "1", "-q"]
    words += ["--checkpoint-every", "0.1s", "--hidden", "8", "--model-hidden", "16"]
    for name in ("models", "rollout_length", "imagined_steps", "horizon", "policy_updates"):
        words += [f"--{name.replace('_', '-')}", str(SMALL[name])]
    words += ["--model-rows", "3000", "--model-batch-size", "64", "--replay-size", "3000"]
    # A ring of the usual size: a whole rollout lies between two checkpoints.
    usual = ("-m", "pacesetter")
    killed = kill_and_resume(words, tmp_path, kills=2, seed=1, program=usual)
    assert main([*words, "--runs", str(tmp_path / "whole")]) == 0
    assert_same(only_run(tmp_path / "whole"), killed)


@pytest.mark.slow
def test_probe_is_learned_in_learned_models(runs: Path) -> None:
    """Reward -4 (a - .5)^2 of a task of one step, whose reward and end must be learned too."""
    settings = {
        **RUN,
        "known": False,
        "models": 3,
        "model_hidden": (64,),
        "model_rows": 100_000,
        "imagined_steps": 1_000,
        "horizon": 5,
        "policy_updates": 40,
        "check_every": 5,
        "patience": 25,
        "steps": 1_500,
    }
    trainer = Trainer("me-trpo", "probe_envs:ActionReward-v0", runs=runs, **settings)
    run_to_end(trainer)
    np.testing.assert_allclose(trainer.policy().act(np.zeros(1)), 0.5, atol=0.15)


# JAX's own checks.


@pytest.mark.parametrize(("renew_every", "noise"), [(0, False), (1, False), (1, True)])
def test_no_key_is_used_twice(renew_every: int, noise: bool) -> None:
    """With learned rewards and ends, with networks drawn anew, with noise in the models."""
    algorithm = learner(known=None, renew_every=renew_every, model_noise=noise)
    flat = jnp.zeros(300)
    batch = Batch(
        observation=flat[:, None],
        action=flat[:, None],
        reward=flat,
        next_observation=flat[:, None],
        discount=flat,
        last=flat,
        weight=flat,
        mask=jnp.zeros((300, 0)),
        starts=jnp.zeros((5, 1)),
        valid=jnp.array(300),
    )
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), jax.random.key(0))
        jax.eval_shape(jax.jit(algorithm.update), state, batch, jax.random.key(0))


# Refusals.


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("me-trpo", {"members": 2}, "members: me-trpo trains one member.* must stay 1, got 2"),
        ("multi-me-trpo", {}, "members: me-trpo trains one member.* must stay 1, got 2"),
        (
            "me-trpo",
            {"normalize_observation": True},
            "normalize_observation: is fixed .* allowed: False, got True",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(name: str, settings: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        resolve(name, "Hopper-v5", settings)


@pytest.mark.parametrize("length", [249, 40_000])
def test_rollouts_that_cannot_be_learned_from_are_refused(length: int, runs: Path) -> None:
    with pytest.raises(UsageError, match=r"^rollout_length: .* must have 250 to 32768 steps"):
        Trainer("me-trpo", "Hopper-v5", runs=runs, **{**RUN, "rollout_length": length})
    assert not runs.exists()


def test_unknown_reward_is_refused_unless_it_is_learned(runs: Path) -> None:
    with pytest.raises(UsageError, match="Pendulum-v1"):
        Trainer("me-trpo", "Pendulum-v1", runs=runs, **RUN)
    assert not runs.exists()


def test_preset_builds_with_the_values_of_its_file() -> None:
    table = config.presets()["me-trpo-paper"]
    run, hyper = resolve("me-trpo-paper", "HalfCheetah-v5")
    for key in table.keys() - {"algorithm", "help", "source", "env"}:
        value = table[key]
        assert getattr(hyper, key) == (tuple(value) if isinstance(value, list) else value), key
    learner = me_trpo.METRPO(Spec(17, 6), hyper)
    state = jax.eval_shape(learner.init, jax.random.key(0))
    assert state.learner.actor.network[0]["kernel"].shape == (17, 32)
    assert state.models.networks.change[0]["kernel"].shape == (5, 23, 1024)
    assert (run.members, table["help"] != "", table["source"] != "") == (1, True, True)


def test_published_sizes() -> None:
    hyper = resolve("me-trpo-paper", "Humanoid-v5").hyper
    assert hyper.model_hidden == (1024, 1024)
    assert (hyper.models, hyper.imagined_steps, hyper.policy_updates) == (5, 50_000, 400)
    assert (hyper.rollout_length, hyper.horizon, hyper.bootstrap) == (6_000, 100, False)


@pytest.mark.parametrize("noise", [False, True])
def test_imagined_steps_are_drawn_where_models_learn_noise(noise: bool) -> None:
    """Two keys, one state and action: the same next state without noise, another with it."""
    algorithm = learner(model_noise=noise)
    models = algorithm.dynamics.init(jax.random.key(0))
    states, actions = jnp.zeros((2, 3, 1)), jnp.zeros((2, 3, 1))
    one, other = (
        np.asarray(
            algorithm.imagined.transition(models, states, actions, jax.random.key(number))[0]
        )
        for number in (1, 2)
    )
    assert np.array_equal(one, other) != noise


def test_ledger_counts_what_the_search_spent(tmp_path: Path) -> None:
    """The sums of the log's own rows, one an iteration."""
    trainer = Trainer("me-trpo", "Hopper-v5", runs=tmp_path, steps=750, **RUN)
    searched = fitted = 0.0
    while trainer.progress.step < trainer.budget:
        trainer.loop.tick()
        told = trainer.loop.training_values()
        searched += told["search_updates"]
        fitted += told["fit_epochs"]
    found = trainer.ledger()
    trainer.close()
    assert found["updates"] == 3
    assert found["resets"] == 3 * SMALL["starts"]
    assert found["policy_updates"] == searched > 0
    assert found["model_epochs"] == fitted > 0
    assert found["imagined_steps"] == searched * SMALL["imagined_steps"]


def test_refuses_episodes_longer_than_all_imagined_steps() -> None:
    for given in ({"imagined_steps": 200}, {"imagined_steps": 200, "horizon": 201}):
        with pytest.raises(UsageError, match=r"horizon.*up to 200"):
            resolve("me-trpo", "Swimmer-v5", given)
    assert resolve("me-trpo", "Swimmer-v5", {"imagined_steps": 200, "horizon": 200})

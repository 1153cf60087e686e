"""TRPO: its mathematics against independent forms, and the iterations that feed it."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from broken_envs import Late
from jax.flatten_util import ravel_pytree
from numeric import near
from scipy.stats import norm
from short_runs import assert_same, log, run_to_end
from stopping import kill_and_resume, only_run, stop_at

from pacesetter import storage
from pacesetter.algorithms import trpo
from pacesetter.algorithms.contract import Update
from pacesetter.batch import Batch, Spec
from pacesetter.cli.main import main
from pacesetter.config import resolve
from pacesetter.errors import TrainingError, UsageError
from pacesetter.learner.compiled import UpdateInputs
from pacesetter.networks import trust_region
from pacesetter.training.trainer import Trainer

SMALL: dict[str, Any] = {
    "hidden": (8, 8),
    "parallel_envs": 3,
    "rollout_length": 20,
    "critic_batch_size": 16,
}
RUN: dict[str, Any] = {**SMALL, "eval_episodes": 1, "eval_every": 1_000, "checkpoint_every": 3600}


def learner(observation: int = 3, action: int = 2, **settings: Any) -> trpo.TRPO:
    return trpo.TRPO(Spec(observation, action), trpo.Hyper(**{**SMALL, **settings}))


def rollout(seed: int, T: int = 20, E: int = 3) -> Batch:  # noqa: N803
    """Random numbers in the shape of a rollout, whose better actions are the larger ones."""
    rng = np.random.default_rng(seed)
    action = rng.normal(size=(T, E, 2)).astype(np.float32)
    terminated = rng.random((T, E)) < 0.1
    return Batch(
        observation=jnp.array(rng.normal(size=(T, E, 3)), jnp.float32),
        action=jnp.array(action),
        reward=jnp.array(action.sum(-1) + rng.normal(size=(T, E)), jnp.float32),
        next_observation=jnp.array(rng.normal(size=(T, E, 3)), jnp.float32),
        discount=jnp.array(0.9 * ~terminated, jnp.float32),
        last=jnp.array(terminated | (rng.random((T, E)) < 0.1), jnp.float32),
        weight=jnp.ones((T, E)),
        mask=jnp.zeros((T, E, 0)),
    )


@pytest.fixture(scope="module")
def updated() -> list[tuple[trpo.State, Batch, Update]]:
    """Twenty updates in a row: the state before each, its rollout and what it gave."""
    algorithm, found = learner(), []
    update = jax.jit(algorithm.update)
    state = algorithm.init(jax.random.key(0))
    for i in range(20):
        batch = rollout(i)
        found.append((state, batch, update(state, batch, jax.random.key(i))))
        state = found[-1][2].state
    return found


# The Gaussian.


def test_log_probability_equals_scipy(rng: np.random.Generator) -> None:
    mean, action, log_std = rng.normal(size=(5, 2)), rng.normal(size=(5, 2)), rng.normal(size=2)
    expected = norm.logpdf(action, mean, np.exp(log_std)).sum(axis=1)
    found = trust_region.log_probability((jnp.array(mean), jnp.array(log_std)), jnp.array(action))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("mean", "std", "expected"), [(0.1, 1.0, 0.005), (0.0, 1.1, 0.0085333), (0.0, 1.0, 0.0)]
)
def test_kl_of_known_pairs(mean: float, std: float, expected: float) -> None:
    """From the standard Gaussian, in the paper's direction KL(old || new)."""
    old = (jnp.zeros((4, 1)), jnp.zeros(1))
    new = (jnp.full((4, 1), mean), jnp.log(jnp.full(1, std)))
    np.testing.assert_allclose(trust_region.kl(old, new), expected, atol=1e-6)


# The step.


def test_fisher_product_equals_hessian_of_kl(rng: np.random.Generator) -> None:
    actor = learner(hidden=(3,), initial_std=0.4).init(jax.random.key(1)).actor
    parameters, unravel = ravel_pytree(actor)
    parameters += 0.3 * rng.normal(size=len(parameters)).astype(np.float32)
    observation = jnp.array(rng.normal(size=(50, 3)), jnp.float32)

    def distribution(parameters: Any) -> trust_region.Distribution:
        return trust_region.distribution_of(unravel(parameters), observation)

    @jax.jit
    def both(parameters: Any) -> Any:
        old = distribution(parameters)
        product = trust_region.fisher_product(distribution, parameters)
        hessian = jax.hessian(lambda p: trust_region.kl(old, distribution(p)))(parameters)
        return jax.vmap(product)(jnp.eye(len(parameters))), hessian

    found, hessian = both(parameters)
    np.testing.assert_allclose(found, hessian, atol=1e-4 * float(jnp.abs(hessian).max()))


def test_conjugate_gradients_solve_a_system_in_dim_steps(rng: np.random.Generator) -> None:
    """In float64 to 1e-6; after half of the steps the solution is still far off."""
    with jax.enable_x64(True):
        basis, _ = np.linalg.qr(rng.normal(size=(12, 12)))
        matrix, right = basis * np.geomspace(1, 100, 12) @ basis.T, rng.normal(size=12)
        expected, system = np.linalg.solve(matrix, right), jnp.array(matrix)
        errors = []
        for steps in (6, 12):
            found, _ = trust_region.cg(lambda x: system @ x, right, tol=1e-12, maxiter=steps)
            errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert errors[1] < 1e-6 < 1e-2 < errors[0]


def test_step_is_along_the_natural_gradient(rng: np.random.Generator) -> None:
    """In float64, with as many steps as parameters: (F + damping)^-1 g, solved by elimination."""
    batch = rollout(3, T=100)
    rows = (batch.observation, batch.action, batch.reward)
    with jax.enable_x64(True):
        algorithm = learner(hidden=(3,), gradient_steps=22, damping=0.1)
        actor = algorithm.init(jax.random.key(0)).actor
        actor = jax.tree.map(lambda x: np.asarray(x + 0.3 * rng.normal(size=x.shape)), actor)
        observation, action, advantage = (
            np.asarray(x, np.float64).reshape(300, *x.shape[2:]) for x in rows
        )
        parameters, unravel = ravel_pytree(actor)
        assert len(parameters) == 22

        def distribution(parameters: Any) -> trust_region.Distribution:
            return trust_region.distribution_of(unravel(parameters), observation)

        def surrogate(parameters: Any) -> Any:  # its gradient where the ratio is 1
            return (
                trust_region.log_probability(distribution(parameters), action) * advantage
            ).mean()

        @jax.jit
        def slopes(parameters: Any) -> Any:
            product = trust_region.fisher_product(distribution, parameters)
            return jax.grad(surrogate)(parameters), jax.vmap(product)(jnp.eye(22))

        gradient, fisher = jax.device_get(slopes(parameters))
        moved, losses = jax.jit(algorithm.fit_actor)(actor, observation, action, advantage)
        step = np.asarray(ravel_pytree(moved)[0] - parameters)
    assert losses["accepted"] == 1
    natural = np.linalg.solve(fisher + algorithm.hyper.damping * np.eye(22), gradient)
    step, natural, gradient = (x / np.linalg.norm(x) for x in (step, natural, gradient))
    np.testing.assert_allclose(step, natural, atol=1e-4)
    assert np.abs(step - gradient).max() > 0.1


def test_small_step_has_the_kl_that_is_allowed() -> None:
    """Where KL is quadratic and next to nothing damps, the whole step lies on the bound."""
    algorithm = learner(
        hidden=(3,), damping=1e-5, max_kl=1e-4, gradient_steps=60, backtrack_ratio=0.98
    )
    batch = rollout(3, T=400)
    actor = algorithm.init(jax.random.key(0)).actor
    flat = [x.reshape(-1, *x.shape[2:]) for x in (batch.observation, batch.action, batch.reward)]
    _, losses = jax.jit(algorithm.fit_actor)(actor, *flat)
    assert losses["accepted"] == 1
    assert 0.9e-4 < losses["kl"] <= 1e-4


def test_updates_stay_in_the_trust_region(updated: Any) -> None:
    """KL and gain, computed anew from the actors before and after, are as reported and allowed."""
    for state, batch, update in updated:
        old, new = (
            trust_region.distribution_of(actor, batch.observation.reshape(-1, 3))
            for actor in (state.actor, update.state.actor)
        )
        divergence = float(trust_region.kl(old, new))
        np.testing.assert_allclose(divergence, update.losses["kl"], rtol=1e-3, atol=1e-7)
        assert update.losses["accepted"] == 1
        assert 0 < divergence <= 0.02 + 1e-6
        assert update.losses["surrogate"] > 0
    first, last = updated[0][0].actor, updated[-1][2].state.actor
    observation = jnp.zeros((1, 3))
    before, after = (trust_region.distribution_of(each, observation)[0] for each in (first, last))
    assert (after - before > 0.3).all()  # larger actions pay more


def test_no_gradient_is_no_step() -> None:
    """Equal advantages ask for nothing: the actor stays as it is, and no 0 / 0 arises."""
    algorithm = learner()
    actor = algorithm.init(jax.random.key(0)).actor
    batch = rollout(0)
    flat = [x.reshape(-1, *x.shape[2:]) for x in (batch.observation, batch.action)]
    moved, losses = jax.jit(algorithm.fit_actor)(actor, *flat, jnp.zeros(60))
    jax.tree.map(np.testing.assert_array_equal, moved, actor)
    assert losses["accepted"] == losses["kl"] == losses["surrogate"] == 0


@pytest.mark.parametrize(("limit", "expected"), [(0.9, 0.8), (0.5, 0.4096), (0.1, 0.0)])
def test_line_search_takes_the_first_that_passes_or_none(limit: float, expected: float) -> None:
    """Lengths 1, .8, .64, ..., five in all: the last, .4096, is tried, the next is not."""
    tried: Any = jnp.float32(limit)

    def judge(candidate: Any) -> Any:
        return candidate[0] <= tried, jnp.stack([candidate[0]])

    start = jnp.zeros(1)
    found, accepted, measures = trust_region.line_search(judge, start, jnp.ones(1), 0.8, 5)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert bool(accepted) == (expected > 0)
    np.testing.assert_allclose(measures, expected, rtol=1e-6)


def test_line_search_takes_no_nan() -> None:
    def judge(candidate: Any) -> Any:
        return jnp.sqrt(-candidate[0]) >= 0, jnp.stack([jnp.nan])

    found, accepted, measures = trust_region.line_search(judge, jnp.zeros(1), jnp.ones(1), 0.8, 3)
    assert (found, accepted, measures) == (0, False, 0)


# Advantages.


def advantages_by_loop(batch: Batch, values: Any, following: Any, decay: float) -> Any:
    """The sum of the definition, term by term."""
    parts = batch.reward, batch.discount, batch.last
    reward, discount, last = (np.asarray(part, float) for part in parts)
    found = np.zeros(reward.shape)
    steps, envs = reward.shape
    for e in range(envs):
        for t in range(steps):
            share = 1.0
            for later in range(t, steps):
                delta = (
                    reward[later, e] + discount[later, e] * following[later, e] - values[later, e]
                )
                found[t, e] += share * delta
                if last[later, e]:
                    break
                share *= decay * discount[later, e]
    return found


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.95, 1.0])
def test_advantages_equal_their_definition(decay: float, rng: np.random.Generator) -> None:
    batch = rollout(5)
    assert 0 < float(batch.last.sum()) < 60
    values, following = rng.normal(size=(2, 20, 3)).astype(np.float32)
    found = trpo.advantages(batch, jnp.array(values), jnp.array(following), decay)
    expected = advantages_by_loop(batch, values, following, decay)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("discounts", "lasts", "expected"),
    [
        # Rewards 1, V(s) = 0, V(s') = 10, gamma .5, lambda 1, by hand.
        ([0.5, 0.5, 0.5], [0, 0, 0], [6 + 0.5 * (6 + 0.5 * 6), 6 + 0.5 * 6, 6]),  # cut by the end
        ([0.5, 0.0, 0.5], [0, 1, 0], [6 + 0.5 * 1, 1, 6]),  # a fall: no value follows
        ([0.5, 0.5, 0.5], [0, 1, 0], [6 + 0.5 * 6, 6, 6]),  # a time limit: its value counts
    ],
)
def test_advantages_at_ends(discounts: Any, lasts: Any, expected: Any) -> None:
    def column(numbers: Any) -> Any:
        return jnp.array(numbers, jnp.float32)[:, None]

    none: Any = None
    batch = Batch(none, none, jnp.ones((3, 1)), none, column(discounts), column(lasts), none)
    found = trpo.advantages(batch, jnp.zeros((3, 1)), jnp.full((3, 1), 10.0), 1.0)
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-6)


# The critic's scale.


def test_sums_equal_those_of_all_values(rng: np.random.Generator) -> None:
    parts = [rng.normal(100, 3, size=50).astype(np.float32) for _ in range(6)]
    sums = jnp.zeros(3)
    assert trpo.standard_deviation(sums) == 1
    for part in parts:
        sums = trpo.add_statistics(sums, jnp.array(part))
    together = np.concatenate(parts)
    np.testing.assert_allclose(trpo.standard_deviation(sums), together.std(), rtol=1e-4)
    np.testing.assert_allclose(sums[:2], [300, together.mean()], rtol=1e-5)


def test_critic_learns_in_units_of_reward() -> None:
    """Rewards of 1,000 are as easy as rewards of 1: the scale takes them out."""
    algorithm = learner(critic_epochs=200, critic_learning_rate=1e-2)
    state = algorithm.init(jax.random.key(0))
    observation = jnp.linspace(-1, 1, 64)[:, None] * jnp.ones(3)
    targets = 1_000 * observation[:, 0]
    state, _ = jax.jit(algorithm.fit_critic)(state, observation, targets, jax.random.key(1))
    np.testing.assert_allclose(algorithm.values(state, observation), targets, atol=50)


# Probe tasks.

LEARNS: dict[str, Any] = {
    **RUN,
    "hidden": (32, 32),
    "parallel_envs": 8,
    "rollout_length": 32,
    "steps": 256 * 20,
    "eval_every": 100_000,
    "gamma": 0.5,
    "max_kl": 0.05,
    "critic_learning_rate": 3e-3,
    "critic_batch_size": 64,
}


def learn(env: str, runs: Path, **kwargs: Any) -> Trainer:
    trainer = Trainer("trpo", f"probe_envs:{env}", runs=runs, env_kwargs=kwargs, **LEARNS)
    run_to_end(trainer)
    return trainer


def values(trainer: Trainer, *observations: float) -> Any:
    mean, deviation = trainer.loop.normalizer.statistics()
    seen = (np.array(observations, np.float32)[:, None] - mean) / deviation
    algorithm: Any = trainer.loop.learners.compiled.learner
    return algorithm.values(trainer.loop.learners.states[0], jnp.array(seen))


def test_probe_constant_reward(runs: Path) -> None:
    near(values(learn("ConstantReward-v0", runs), 0), 1)


def test_probe_reward_that_is_seen(runs: Path) -> None:
    near(values(learn("ObservationReward-v0", runs), -1, 1), [-1, 1])


def test_probe_reward_that_comes_later(runs: Path) -> None:
    near(values(learn("TwoSteps-v0", runs), 0, 1), [0.5, 1])


def test_probe_time_limit_is_no_end_of_the_task(runs: Path) -> None:
    """Reward 1 for ever, cut after 3 steps, is worth 1 / (1 - .5)."""
    near(values(learn("Corridor-v0", runs, blind=True, max_episode_steps=3), 0), 2)


def test_probe_a_fall_is_the_end_of_the_task(runs: Path) -> None:
    near(values(learn("Corridor-v0", runs, falls_at=3), 0, 1, 2), [1.75, 1.5, 1])


def test_probe_reward_of_the_action(runs: Path) -> None:
    """Best is 1 in a box of 0 to 4, which is -.5 inside."""
    trainer = learn("ActionReward-v0", runs, low=0.0, high=4.0, best=1.0, steepness=1.0)
    near(trainer.policy().act(np.zeros(1)), -0.5)
    near(trainer.policy()(np.zeros(1)) / 2, 0.5)


def test_probe_reward_of_the_action_that_fits_what_is_seen(runs: Path) -> None:
    trainer = learn("BothReward-v0", runs)
    near(trainer.policy()(np.array([[-1], [1]])), [[-0.5], [0.5]])


# Iterations.


def watch(trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What the learner acts with, its rows and statistics, at each update."""
    loop: Any = trainer.loop
    seen: list[tuple[Any, ...]] = []
    update = loop.learners.compiled.update

    def spy(state: Any, member: int, inputs: UpdateInputs) -> Any:
        seen.append((loop.learners.policy_params[0], inputs.rows.copy(), inputs.statistics))
        return update(state, member, inputs)

    monkeypatch.setattr(loop.learners.compiled, "update", spy)
    return seen


@pytest.mark.parametrize("steps", [60 * 3, 60 * 4 - 1])
def test_budget_is_made_exactly(steps: int, runs: Path) -> None:
    """Whole rollouts are learned from; what is left is stepped, but too little to learn from."""
    trainer = Trainer("trpo", "Hopper-v5", runs=runs, steps=steps, **RUN)
    last = log(run_to_end(trainer))[-1]
    assert last["step"] == steps
    assert last["member_steps"] == [steps]
    assert last["updates"] == steps // 60
    assert last["transitions"] == steps // 60 * 60
    assert last["critic_updates"] == steps // 60 * 20 * 3


def test_every_update_has_a_number_of_its_own(runs: Path) -> None:
    """Which its random key is made of."""
    settings = {**RUN, "rollout_length": 4, "steps": 36}
    trainer = Trainer("trpo", "probe_envs:Scripted-v0", runs=runs, **settings)
    compiled, numbers = trainer.loop.learners.compiled, list[int]()
    update = compiled.update

    def watched(state: Any, member: int, inputs: UpdateInputs) -> Any:
        numbers.append(inputs.call)
        return update(state, member, inputs)

    compiled.update = watched  # type: ignore[method-assign]
    run_to_end(trainer)
    assert numbers == [0, 1, 2]


def test_rollout_follows_each_env_in_time(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Corridor observes how many steps an episode has: 0, 1, 2, 0, ... in each env's column."""
    kwargs = {"max_episode_steps": 3}
    settings = {**RUN, "normalize_observation": False, "rollout_length": 4, "steps": 24}
    trainer = Trainer("trpo", "probe_envs:Corridor-v0", runs=runs, env_kwargs=kwargs, **settings)
    seen = watch(trainer, monkeypatch)
    run_to_end(trainer)
    rows = np.concatenate([rows for _, rows, _ in seen])
    batch = trainer.loop.learners.compiled.layout.unpack(jnp.array(rows))
    np.testing.assert_array_equal(batch.observation[..., 0], np.arange(8)[:, None] % 3 * [1, 1, 1])
    np.testing.assert_array_equal(batch.next_observation[..., 0], batch.observation[..., 0] + 1)
    np.testing.assert_array_equal(batch.last, batch.next_observation[..., 0] == 3)
    np.testing.assert_allclose(batch.discount, 0.99, rtol=1e-6)


def test_actions_are_stored_uncut_and_done_cut(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The env echoes what it was given; stored actions have the policy's own distribution."""
    kwargs = {"low": [-1.0], "high": [1.0]}
    settings = {**RUN, "initial_std": 2.0, "rollout_length": 400, "steps": 1200}
    trainer = Trainer("trpo", "probe_envs:Echo-v0", runs=runs, env_kwargs=kwargs, **settings)
    ((_, rows, _),) = (seen := watch(trainer, monkeypatch), run_to_end(trainer))[0]
    assert len(seen) == 1
    batch = trainer.loop.learners.compiled.layout.unpack(jnp.array(rows))
    np.testing.assert_allclose(batch.action.std(), 2, atol=0.15)
    np.testing.assert_allclose(batch.next_observation, jnp.clip(batch.action, -1, 1), atol=1e-6)


def test_statistics_stay_during_an_iteration(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The update sees observations as acting saw them, so noise is what acting drew; statistics
    then take in the rollout."""
    trainer = Trainer("trpo", "Hopper-v5", runs=runs, steps=240, **RUN)
    seen = watch(trainer, monkeypatch)
    run_to_end(trainer)
    streams = [np.random.Generator(np.random.PCG64(0)) for _ in range(3)]
    fresh = Trainer("trpo", "Hopper-v5", runs=runs, name="fresh", steps=240, **RUN)
    for stream, explorer in zip(streams, fresh.loop.explorers, strict=True):
        stream.bit_generator.state = explorer.act_stream.bit_generator.state
    fresh.close()
    gathered: list[Any] = []
    for params, rows, (mean, deviation) in seen:
        if gathered:
            together = np.concatenate(gathered)
            np.testing.assert_allclose(mean, together.mean(axis=0), rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(deviation, together.std(axis=0), rtol=1e-3, atol=1e-3)
        batch = trainer.loop.learners.compiled.layout.unpack(jnp.array(rows))
        scaled = jnp.clip((batch.observation - mean) / deviation, -10, 10)
        middle, log_std = trust_region.distribution_of(trust_region.Gaussian(*params), scaled)
        noise = (batch.action - middle) / np.exp(log_std)
        drawn = np.stack([rng.standard_normal((20, 3), np.float32) for rng in streams], axis=1)
        np.testing.assert_allclose(noise, drawn, atol=1e-4)
        gathered.append(np.asarray(batch.observation).reshape(60, -1))


@pytest.mark.parametrize("normalize", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_stopped_run_equals_uninterrupted(normalize: bool, runs: Path) -> None:
    """Between iterations, with episodes that run on through several of them."""

    def start(name: str) -> Trainer:
        settings = {**RUN, "steps": 1_000, "normalize_observation": normalize, "name": name}
        return Trainer("trpo", "HalfCheetah-v5", runs=runs, **settings)

    whole, stopped = run_to_end(start("whole")), start("stopped")
    for tick in (1, 4, 13):
        stop_at(stopped, tick)
        assert not stopped.finished
        stopped = Trainer.resume(stopped.directory.path)
        assert stopped.notes == []
        assert stopped.progress.step == tick * 60
    assert_same(whole, run_to_end(stopped))
    arrays, _ = storage.read(whole.state_file, "checkpoint")
    assert len(arrays["env.2.actions"]) == 333


@pytest.mark.slow
def test_killed_run_equals_undisturbed(tmp_path: Path) -> None:
    words = [
        "train",
        "trpo",
        "Hopper-v5",
        "--steps",
        "20000",
        "--hidden",
        "16",
        "--parallel-envs",
        "4",
    ]
    words += ["--rollout-length", "50", "--eval-every", "5000", "--eval-episodes", "1", "-q"]
    words += ["--checkpoint-every", "0.2s"]
    killed = kill_and_resume(words, tmp_path, kills=3, seed=1)
    assert main([*words, "--runs", str(tmp_path / "whole")]) == 0
    assert_same(only_run(tmp_path / "whole"), killed)


def test_fault_of_an_env_is_named(runs: Path, disarmed: None) -> None:
    """Env 1 acts second in each turn, so its step 5 is the run's step 13 of three envs."""
    settings = {**RUN, "steps": 300, "renew_env": False}
    Late.arm("nan", victim=1, at=5)
    trainer = Trainer("trpo", "broken_envs:Late-v0", runs=runs, **settings)
    with pytest.raises(TrainingError, match=r"^env 1, step 13: .*observation"):
        run_to_end(trainer)


def test_listed_without_a_multi_form(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "algorithms"]) == 0
    words = capsys.readouterr().out.split()
    assert "trpo" in words
    assert "multi-trpo" not in words


# JAX's own checks.


def test_no_key_is_used_twice() -> None:
    algorithm = learner()
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), jax.random.key(0))
        jax.eval_shape(jax.jit(algorithm.update), state, rollout(0), jax.random.key(0))


def test_nothing_is_nan(runs: Path, nans_raise: None) -> None:
    """Thirty updates of a short run."""
    settings = {**RUN, "parallel_envs": 2, "steps": 40 * 30}
    trainer = Trainer("trpo", "probe_envs:Scripted-v0", runs=runs, **settings)
    assert run_to_end(trainer).rows()[-1]["updates"] == 30


# Refusals.


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("trpo", {"members": 2}, "members: trpo trains one member.* must stay 1, got 2"),
        ("multi-trpo", {}, "members: trpo trains one member.* must stay 1, got 2"),
        ("trpo", {"rule": "none"}, "rule: trpo trains one member.* must stay best, got none"),
        ("trpo", {"replay_scope": "member"}, "replay_scope: .* must stay shared"),
        ("trpo", {"steps": 100}, "steps: 100 is less than one rollout of 1024"),
        ("trpo", {"batch_size": 64}, "setting: unknown 'batch_size'"),
        (
            "trpo",
            {"parallel_envs": 0},
            "parallel_envs: should be .* equal to 1, got 0",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(name: str, settings: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        resolve(name, "Hopper-v5", settings)

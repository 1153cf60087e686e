"""Parameter noise: whose weights are noisy, when they are drawn, and how sigma finds its size."""

import copy
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from learners import NETWORKS
from learners import learner as any_learner
from numeric import KEY, SPEC, perceptron, random_batch, random_state, same, single
from short_runs import TINY, run_to_end

from pacesetter.algorithms import td3
from pacesetter.ensemble.copying import copy_from_parents
from pacesetter.errors import UsageError
from pacesetter.networks import exploration, mlp
from pacesetter.policy import unstack
from pacesetter.training.trainer import Trainer

NOISY = {"exploration": "parameter", "actor_layer_norm": True}
adapt = jax.jit(exploration.adapt_sigma, static_argnums=2)
perturb, act = jax.jit(exploration.perturb), jax.jit(mlp.actor)


def learner(name: str = "td3", **hyper: Any) -> td3.TD3:
    return any_learner(name, **{"hidden": (8, 6), **NOISY, **hyper})


def new_state(algorithm: td3.TD3, rng: np.random.Generator) -> Any:
    return single(random_state(algorithm, rng, *NETWORKS))


# Sigma.


def linear_actor(inputs: int, outputs: int) -> Any:
    """One layer of zeros, whose small actions tanh leaves as they are."""
    return ({"kernel": np.zeros((inputs, outputs)), "bias": np.zeros(outputs)},)


def test_sigma_finds_the_distance_that_is_wanted(rng: np.random.Generator) -> None:
    """For a = W s + b and s ~ N(0, I_n), sigma sqrt(n + 1) settles at delta within 5%."""
    actor, delta, sigma, found = linear_actor(8, 4), 0.05, 0.2, []
    for i in range(600):
        observation = rng.normal(size=(64, 8)).astype(np.float32)
        sigma = adapt(sigma, actor, delta, observation, jax.random.key(i))
        found.append(float(sigma))
    assert np.mean(found[300:]) * 3 == pytest.approx(delta, rel=0.05)


@pytest.mark.parametrize(("goal", "factor"), [(0.0, 0.1), (10.0, 10.0)])
def test_sigma_moves_one_per_cent_a_time(goal: float, factor: float) -> None:
    """231 adaptations are a factor of 10, down where actions are too far apart, up where near."""
    sigma = start = np.float32(0.01)
    for _ in range(231):
        sigma = adapt(sigma, linear_actor(3, 2), goal, np.ones((4, 3), np.float32), KEY)
    assert float(sigma) / start == pytest.approx(factor, rel=0.005)


@pytest.mark.parametrize(("goal", "cap"), [(0.0, 1e-4), (10.0, 1.0)])
def test_sigma_is_capped(goal: float, cap: float) -> None:
    """Where actions never are as far apart as wanted, sigma stays at 1, and at 1e-4 below."""
    sigma = np.float32(cap * (1.005 if goal == 0 else 0.995))
    for _ in range(3):
        sigma = adapt(sigma, linear_actor(3, 2), goal, np.ones((4, 3), np.float32), KEY)
    assert float(sigma) == np.float32(cap)


def test_distance_grows_with_sigma(rng: np.random.Generator) -> None:
    """The same directions of noise lead further away, in an actor with layer norm."""
    algorithm = learner()
    actor = new_state(algorithm, rng).actor
    observation = rng.normal(size=(64, 3)).astype(np.float32)
    clean = act(actor, observation)

    def distance(sigma: float) -> float:
        noisy = perturb(actor, np.float32(sigma), KEY)
        return float(((act(noisy, observation) - clean) ** 2).mean() ** 0.5)

    distances = [distance(sigma) for sigma in (1e-4, 1e-3, 0.01, 0.03, 0.1)]
    assert np.all(np.diff(distances) > 0)


def test_noise_spares_the_gains_of_layer_norm(rng: np.random.Generator) -> None:
    """Weights and biases get independent noise of deviation sigma, in what learns and what acts."""
    algorithm = learner(hidden=(300, 200))
    actor = new_state(algorithm, rng).actor
    before = copy.deepcopy(actor)
    for noisy in (
        perturb(actor, np.float32(0.3), KEY),
        algorithm.start_episode((actor, np.float32(0.3)), rng),
    ):
        for clean, layer in zip(actor, noisy, strict=True):
            assert clean.keys() == layer.keys()
            for name, array in layer.items():
                noise = np.asarray(array - clean[name])
                assert array.dtype == np.float32
                if name in ("scale", "offset"):
                    assert not noise.any()
                elif noise.size > 1000:
                    assert noise.std() == pytest.approx(0.3, rel=5 / (2 * noise.size) ** 0.5)
                    assert abs(noise.mean()) < 5 * 0.3 / noise.size**0.5
                else:
                    assert noise.all()
    assert same(actor, before)


# The learner.


@pytest.mark.parametrize("delay", [2, 3])
def test_sigma_adapts_every_50_updates(delay: int, rng: np.random.Generator) -> None:
    """In the cycle that reaches or passes 50, 100, 150 updates, and in no other."""
    algorithm = learner(policy_delay=delay, batch_size=4)
    state, moved = jax.jit(algorithm.init)(KEY), []
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, delay, 4))
    update = jax.jit(algorithm.update)
    assert float(state.exploration) == np.float32(0.1)
    for i in range(160 // delay):
        result = update(state, batch, jax.random.key(i))
        ratio = float(result.state.exploration) / float(state.exploration)
        if ratio != 1:
            assert ratio == pytest.approx(1.01 if ratio > 1 else 1 / 1.01, rel=1e-6)
            moved.append(int(result.state.updates))
        state = result.state
        assert result.losses["sigma"] == state.exploration
    assert moved == [-(-n // delay) * delay for n in (50, 100, 150)]


@pytest.mark.parametrize("name", ["td3", "ddpg"])
def test_learning_knows_only_the_clean_policy(name: str, rng: np.random.Generator) -> None:
    """Whatever sigma is, networks, moments, losses and errors are those of gaussian noise."""
    algorithm, plain = learner(name), learner(name, exploration="gaussian")
    state = new_state(algorithm, rng)
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, algorithm.updates_per_call, 16))
    update = jax.jit(algorithm.update)
    found = [update(state._replace(exploration=np.float32(s)), batch, KEY) for s in (1e-3, 0.9)]
    reference = jax.jit(plain.update)(state._replace(exploration=()), batch, KEY)
    for one in found:
        assert same(one.state._replace(exploration=()), reference.state)
        assert same(one.td_error, reference.td_error)
        assert same({k: v for k, v in one.losses.items() if k != "sigma"}, reference.losses)


def test_policy_is_clean(rng: np.random.Generator) -> None:
    """What is evaluated and written is the actor itself."""
    algorithm = learner()
    state = new_state(algorithm, rng)
    (layers,) = unstack(algorithm.policy(state).layers)
    assert same(layers, list(state.actor))


def test_an_episode_is_acted_by_one_noisy_actor(rng: np.random.Generator) -> None:
    """Its actions are the noisy actor's own, it does not change, and nothing else is drawn."""
    algorithm = learner()
    params = jax.device_get(algorithm.policy_params(new_state(algorithm, rng)))
    first = noise_state = algorithm.start_episode(params, rng)
    drawn = rng.bit_generator.state
    for _ in range(3):
        observation = np.ones(3, np.float32)
        action, noise_state = algorithm.act(params, noise_state, observation, rng)
        np.testing.assert_allclose(action, np.tanh(perceptron(first, observation)), atol=1e-5)
        assert noise_state is first
    assert rng.bit_generator.state == drawn
    assert not same(first, algorithm.start_episode(params, rng))


def test_noisy_actor_lasts_an_episode(runs: Path) -> None:
    """In a run that learns: drawn anew where an episode begins, and nowhere else."""
    settings = {**TINY, **NOISY, "warmup": 20, "steps": 100}
    trainer = Trainer("td3", "probe_envs:Scripted-v0", runs=runs, **settings)
    loop = trainer.loop
    step, seen = loop._step, []

    def watched(k: int) -> None:
        explorer = loop.explorers[k]
        seen.append((not explorer.env.actions, copy.deepcopy(explorer.noise_state)))
        step(k)

    loop._step = watched
    run_to_end(trainer)
    assert [start for start, _ in seen] == [i % 10 == 0 for i in range(100)]
    for (_, before), (start, after) in pairwise(seen):
        assert same(before, after) != start


@pytest.mark.parametrize("mode", ["full", "weights", "actor"])
def test_sigma_is_copied_with_its_actor(mode: str, rng: np.random.Generator) -> None:
    """Whatever else a copy takes along, the parent's sigma fits the parent's actor."""
    algorithm = learner()
    states = [new_state(algorithm, rng)._replace(exploration=np.float32(s)) for s in (0.2, 0.7)]
    copied = copy_from_parents(algorithm, states, np.array([1, 1]), mode)
    assert [float(state.exploration) for state in copied] == [np.float32(0.7)] * 2
    assert same(copied[0].actor, states[1].actor)


@pytest.mark.parametrize("mode", ["full", "weights", "actor"])
def test_without_parameter_noise_there_is_no_sigma(mode: str, rng: np.random.Generator) -> None:
    algorithm = learner(exploration="gaussian")
    states = [new_state(algorithm, rng) for _ in range(2)]
    copied = copy_from_parents(algorithm, states, np.array([1, 1]), mode)
    assert [state.exploration for state in (*states, *copied)] == [()] * 4


@pytest.mark.parametrize("name", ["td3", "ddpg"])
def test_parameter_noise_needs_layer_norm(name: str, runs: Path) -> None:
    """Refused in one line that says what to add, before anything is written."""
    with pytest.raises(UsageError, match=r"^exploration: .*--actor-layer-norm") as caught:
        Trainer(name, "probe_envs:Scripted-v0", runs=runs, exploration="parameter")
    assert "\n" not in str(caught.value)
    assert not runs.exists()


@pytest.mark.parametrize("name", ["sac", "crossq"])
@pytest.mark.parametrize("kind", ["gaussian", "ou", "parameter"])
def test_stochastic_policies_explore_by_themselves(name: str, kind: str, runs: Path) -> None:
    """The one flag says so, and takes nothing else."""
    with pytest.raises(UsageError, match=r"^exploration: .*by itself; allowed: policy"):
        Trainer(name, "probe_envs:Scripted-v0", runs=runs, exploration=kind)


def test_a_learner_uses_no_key_twice(rng: np.random.Generator) -> None:
    algorithm = learner()
    batch = jax.tree.map(np.float32, random_batch(rng, SPEC, algorithm.updates_per_call, 7))
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), KEY)
        jax.eval_shape(jax.jit(algorithm.update), state, batch, KEY)

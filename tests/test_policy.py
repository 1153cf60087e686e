"""A policy file acts and is scored with NumPy alone, always within the env's own bounds."""

import json
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from policies import untrained
from short_runs import TINY, run_to_end

from pacesetter.cli.main import main
from pacesetter.envs import Recipe
from pacesetter.errors import UsageError
from pacesetter.evaluation import evaluate
from pacesetter.networks import mlp
from pacesetter.policy import Policy, load, unstack
from pacesetter.training.trainer import Trainer
from pacesetter.types import Layers

PROBE = "broken_envs:Probe-v0"


def make_layers(rng: np.random.Generator, sizes: list[int], norm: bool = False) -> Layers:
    """Random layers from one size to the next."""
    layers: Layers = []
    for index, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        layer = {"kernel": rng.normal(size=(fan_in, fan_out)), "bias": rng.normal(size=fan_out)}
        if norm and index < len(sizes) - 2:
            layer |= {"scale": rng.normal(size=fan_out), "offset": rng.normal(size=fan_out)}
        layers.append({name: (array / 2).astype(np.float32) for name, array in layer.items()})
    return layers


def make_policy(
    env: str, rng: np.random.Generator, actors: int = 1, norm: bool = False, scale: bool = False
) -> Policy:
    """A random policy for a task."""
    task = Recipe(env).make()
    space: Any = task.action_space
    size = int(np.prod(task.observation_space.shape or ()))
    task.close()
    sizes = [size, 16, 12, len(space.low)]
    normalizer = rng.normal(size=(2, size)).astype(np.float32)
    return Policy(
        [make_layers(rng, sizes, norm) for _ in range(actors)],
        "relu",
        "tanh",
        space.low.astype(np.float32),
        space.high.astype(np.float32),
        (normalizer[0], 0.1 + np.abs(normalizer[1])) if scale else None,
        {"env": env, "env_kwargs": {}, "step": 7},
    )


SCRIPT = """
import json, sys
import pacesetter
from pacesetter.cli.main import main
policy = pacesetter.load(sys.argv[1])
result = pacesetter.evaluate(policy, episodes=2, seed=4)
assert main(["eval", sys.argv[1], "--episodes", "2", "--seed", "4", "--json"]) == 0
heavy = [name for name in ("jax", "jaxlib", "optax", "torch") if name in sys.modules]
print(json.dumps([result.returns, heavy]))
"""


@pytest.mark.parametrize("actors", [1, 3])
def test_policy_needs_numpy_only(actors: int, tmp_path: Path, rng: np.random.Generator) -> None:
    """Loading, acting, evaluating and the `eval` command never import JAX; of SUNRISE's several
    averaged actors too."""
    file = tmp_path / "policy.safetensors"
    make_policy("Hopper-v5", rng, actors=actors).save(file)
    command = [sys.executable, "-c", SCRIPT, str(file)]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    told, (returns, heavy) = (json.loads(line) for line in found.stdout.splitlines())
    assert heavy == []
    assert told["returns"] == returns
    assert returns == evaluate(load(file), episodes=2, seed=4).returns


KINDS = {
    "plain": {},
    "layer norm": {"norm": True},
    "normalised": {"scale": True},
    "ensemble": {"actors": 3},
    "all": {"actors": 2, "norm": True, "scale": True},
}


@pytest.mark.parametrize("kind", KINDS)
def test_batch_and_single_agree(kind: str, rng: np.random.Generator) -> None:
    policy = make_policy("Walker2d-v5", rng, **KINDS[kind])
    observations = rng.normal(size=(2, 5, 17)) * 3
    batch = policy(observations)
    assert batch.shape == (2, 5, 6)
    assert batch.dtype == np.float32
    single = [[policy(one) for one in row] for row in observations]
    np.testing.assert_allclose(batch, single, rtol=0, atol=2e-6)
    assert batch.std() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_file_holds_all_of_a_policy(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """The loaded policy acts the same, bit for bit."""
    policy = make_policy("Walker2d-v5", rng, **KINDS[kind])
    policy.save(tmp_path / "file")
    loaded = load(tmp_path / "file")
    observations = rng.normal(size=(50, 17)) * 5
    assert loaded(observations).tobytes() == policy(observations).tobytes()
    assert loaded.about == policy.about
    assert len(loaded.actors) == len(policy.actors)


@pytest.mark.parametrize("wrap", [[7], [["a:B"]], "a:B"])
def test_wrappers_of_a_file_are_names(
    wrap: object, tmp_path: Path, rng: np.random.Generator
) -> None:
    policy = make_policy("Walker2d-v5", rng)
    policy.about["wrap"] = wrap
    policy.save(tmp_path / "file")
    with pytest.raises(UsageError, match="damaged policy: wrap must be a list"):
        load(tmp_path / "file")


@pytest.mark.parametrize("norm", [False, True])
def test_numpy_equals_jax(norm: bool, rng: np.random.Generator) -> None:
    """The actor that was trained is the actor that is written."""
    policy = make_policy("Walker2d-v5", rng, norm=norm)
    observations = rng.normal(size=(40, 17)).astype(np.float32)
    network = tuple(
        {name: jnp.array(array) for name, array in layer.items()} for layer in policy.actors[0]
    )
    expected = np.asarray(mlp.actor(network, jnp.array(observations)))
    np.testing.assert_allclose(policy.act(observations), expected, rtol=0, atol=1e-5)


def test_actions_have_the_shape_of_the_env(runs: Path) -> None:
    """One observation or any batch of them, as the env gives them."""
    settings = {**TINY, "steps": 5, "env_kwargs": {"max_episode_steps": 5}}
    trainer = Trainer("td3", "broken_envs:Square-v0", runs=runs, **settings)
    policy = load(run_to_end(trainer).policy_file)
    assert policy(np.zeros((3, 2))).shape == (1, 2)
    assert policy(np.zeros((7, 4, 3, 2))).shape == (7, 4, 1, 2)
    with pytest.raises(UsageError, match=r"shape \(6,\) given; this policy takes \(\.\.\., 3, 2\)"):
        policy(np.zeros(6))


def test_ensemble_averages(rng: np.random.Generator) -> None:
    """N actors act as the mean of what each does alone; normalised inputs are cut at 10."""
    policy = make_policy("Hopper-v5", rng, actors=4, scale=True)
    observation = rng.normal(size=11).astype(np.float32) * 100
    assert policy.normalizer is not None
    mean, deviation = policy.normalizer
    seen = np.clip((observation - mean) / deviation, -10, 10)
    alone = [
        Policy([layers], "relu", "tanh", policy.low, policy.high).act(seen)
        for layers in policy.actors
    ]
    np.testing.assert_allclose(policy.act(observation), np.mean(alone, axis=0), atol=1e-6)
    assert np.ptp(alone, axis=0).max() > 0.1


def test_stacked_actors_come_apart(rng: np.random.Generator) -> None:
    actors = [make_layers(rng, [3, 4, 2]) for _ in range(3)]
    stacked = [
        {name: np.stack([layers[i][name] for layers in actors]) for name in ("kernel", "bias")}
        for i in range(2)
    ]
    for mine, found in zip(actors, unstack(stacked), strict=True):
        for one, other in zip(mine, found, strict=True):
            assert all(np.array_equal(one[name], other[name]) for name in one)


BOUNDS = {"Humanoid-v5": (-0.4, 0.4), "HalfCheetah-v5": (-1, 1), PROBE: ([-2, 0], [1, 4])}


@pytest.mark.parametrize("env", BOUNDS)
def test_actions_are_in_the_envs_units(env: str, rng: np.random.Generator) -> None:
    """From bound to bound and never beyond, however large the observation."""
    random = make_policy(env, rng)
    size, outputs = random.observation_size, len(random.low)
    policy = replace(random, actors=[make_layers(rng, [size, outputs])])
    low, high = (np.broadcast_to(np.float32(bound), outputs) for bound in BOUNDS[env])
    actions = policy(rng.normal(size=(300, size)) * 10.0 ** rng.integers(-3, 6, size=(300, 1)))
    assert (actions >= low).all()
    assert (actions <= high).all()
    np.testing.assert_array_equal(actions.min(axis=0), low)
    np.testing.assert_array_equal(actions.max(axis=0), high)
    still = [{"kernel": np.zeros((size, outputs), np.float32), "bias": np.zeros(outputs)}]
    middle = replace(policy, actors=[still])(np.zeros(size))
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-6)


@pytest.mark.parametrize("shape", [(16,), (18,), (17, 1), (), (3, 18)])
def test_wrong_observation_is_refused(shape: tuple[int, ...], rng: np.random.Generator) -> None:
    policy = make_policy("Walker2d-v5", rng)
    with pytest.raises(UsageError, match="17"):
        policy(np.zeros(shape))


def test_json_of_eval(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """Keys, repeatability by seed, and what noise does."""
    file = tmp_path / "policy.safetensors"
    make_policy("Hopper-v5", rng).save(file)

    def run(*words: str) -> dict[str, Any]:
        assert main(["eval", str(file), "--episodes", "3", "--json", *words]) == 0
        return json.loads(capsys.readouterr().out)

    first = run()
    assert first.keys() >= {"returns", "lengths", "mean", "std", "env", "seed", "noise", "policy"}
    assert len(first["returns"]) == len(first["lengths"]) == 3
    assert first["mean"] == pytest.approx(np.mean(first["returns"]))
    assert first["std"] == pytest.approx(np.std(first["returns"]))
    assert first["std"] > 0
    assert all(0 < length <= 1000 for length in first["lengths"])
    assert run() == first
    assert run("--seed", "1")["returns"] != first["returns"]
    noisy = run("--noise", "0.3")
    assert noisy["returns"] != first["returns"]
    assert run("--noise", "0.3") == noisy


def test_eval_on_another_version_of_the_task(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """`--env` takes the place of the task in the file."""
    file = tmp_path / "policy.safetensors"
    make_policy("Walker2d-v5", rng).save(file)
    assert main(["eval", str(file), "--episodes", "1", "--env", "Walker2d-v4"]) == 0
    assert capsys.readouterr().out.startswith("Walker2d-v4: return")


def test_an_id_without_a_version_is_the_policys_own_task(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the keywords that it was trained with, in Python and on the command line."""
    own, file = untrained("Pendulum-v1", env_kwargs={"g": 2.0}), tmp_path / "policy.safetensors"
    assert evaluate(own, "Pendulum", 1, seed=1) == evaluate(own, None, 1, seed=1)
    own.save(file)
    said: list[str] = []
    for words in ([], ["--env", "Pendulum"]):
        assert main(["eval", str(file), "--episodes", "1", *words]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1]


def test_random_actions_are_a_baseline() -> None:
    """Without a policy, actions are random, seeded, and spread over the bounds."""
    first, again = (evaluate(None, "Hopper-v5", 3, seed=1) for _ in range(2))
    assert first == again
    assert first.returns != evaluate(None, "Hopper-v5", 3, seed=2).returns
    with pytest.raises(UsageError, match="env"):
        evaluate(None)


def test_score_in_the_file(runs: Path) -> None:
    """The files of a run hold the score that the log has for that step."""
    trainer = Trainer("td3", PROBE, runs=runs, **{**TINY, "steps": 600, "eval_every": 150})
    directory = run_to_end(trainer)
    rows = [row for row in directory.rows() if row["kind"] == "eval"]
    about = load(directory.policy_file).about
    assert (about["score"], about["score_std"]) == (rows[-1]["mean"], rows[-1]["std"])
    assert (about["step"], about["score_episodes"]) == (600, 1)
    assert about["env"] == PROBE
    best = load(directory.best_file).about
    top = max(rows[1:], key=lambda row: row["mean"])
    assert (best["score"], best["step"]) == (top["mean"], top["step"])
    assert "bias" in best["score_note"]
    assert "score_note" not in about
    observation = np.float32([0.1, -0.2, 0.3])
    for path in (directory.policy_file, directory.path, str(directory.path)):
        assert np.array_equal(load(path)(observation), trainer.policy()(observation))

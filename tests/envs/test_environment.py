"""The border to Gymnasium: sizes, scaling of actions, and episodes that are entered again."""

from typing import Any

import numpy as np
import pytest
from broken_envs import Restless
from short_runs import TINY, run_to_step

from pacesetter.envs import Environment, Recipe, known
from pacesetter.errors import TrainingError
from pacesetter.evaluation import rollouts
from pacesetter.policy import to_env
from pacesetter.seeding import Stream, episode_seed
from pacesetter.training.trainer import Trainer

SIZES = {
    "HalfCheetah-v4": (17, 6),
    "HalfCheetah-v5": (17, 6),
    "Walker2d-v4": (17, 6),
    "Walker2d-v5": (17, 6),
    "Ant-v4": (27, 8),
    "Ant-v5": (105, 8),
    "pacesetter/Ant111-v4": (111, 8),
    "Humanoid-v4": (376, 17),
    "Humanoid-v5": (348, 17),
    "Hopper-v4": (11, 3),
    "Hopper-v5": (11, 3),
    "Swimmer-v4": (8, 2),
    "Swimmer-v5": (8, 2),
}


def world(name: str, seed: int = 3, index: int = 0, **kwargs: Any) -> Environment:
    return Environment(Recipe(name, kwargs), seed, Stream.TRAIN, index)


@pytest.mark.parametrize("name", SIZES)
def test_walkers_step(name: str, rng: np.random.Generator) -> None:
    env = world(name)
    assert (env.observation_size, env.action_size) == SIZES[name]
    observation = env.reset()
    total = 0.0
    for _ in range(5):
        step = env.step(rng.uniform(-1, 1, env.action_size).astype(np.float32))
        assert step.observation.shape == observation.shape == (SIZES[name][0],)
        assert step.observation.dtype == np.float32
        assert not np.array_equal(step.observation, observation)
        observation = step.observation
        total += step.reward
    assert total != 0
    env.close()


def test_ant_of_the_papers(rng: np.random.Generator) -> None:
    """27 numbers as in Ant-v4, then 84 zeros; everything else is Ant-v4."""
    ant, padded = world("Ant-v4"), world("pacesetter/Ant111-v4")
    observations = [(ant.reset(), padded.reset())]
    for _ in range(200):
        action = rng.uniform(-1, 1, 8).astype(np.float32)
        one, other = ant.step(action), padded.step(action)
        observations.append((one.observation, other.observation))
        assert one[1:4] == other[1:4]
        if one.ended:
            observations.append((ant.reset(), padded.reset()))
    for one, other in observations:
        assert np.array_equal(one, other[:27])
        assert not other[27:].any()


@pytest.mark.parametrize("name", ["Ant-v4", "pacesetter/Ant111-v4", "Ant-v5"])
def test_time_limit_truncates(name: str) -> None:
    """At step 1000, by the limit and not by the task."""
    env = world(name, terminate_when_unhealthy=False)
    env.reset()
    steps = [env.step(np.zeros(8, np.float32)) for _ in range(1000)]
    assert not any(step.ended for step in steps[:-1])
    assert (steps[-1].terminated, steps[-1].truncated) == (False, True)


def test_falling_terminates(rng: np.random.Generator) -> None:
    env = world("Hopper-v5")
    env.reset()
    while not (step := env.step(rng.uniform(-1, 1, 3).astype(np.float32))).ended:
        pass
    assert (step.terminated, step.truncated) == (True, False)


def test_env_gets_its_own_units() -> None:
    """The task sees an action that lies in its own space and has its own type."""
    for name, size in (("Humanoid-v5", 17), ("Humanoid-v4", 17), ("Walker2d-v5", 6)):
        env = world(name)
        env.reset()
        seen: list[Any] = []
        inner: Any = env.env.unwrapped
        step = inner.step
        inner.step = lambda action, step=step, seen=seen: (seen.append(action), step(action))[1]
        for action in (-7.0, -1.0, 0.0, 1.0, 7.0):
            env.step(np.full(size, action, np.float32))
        space: Any = inner.action_space
        assert all(space.contains(action) for action in seen)
        expected = [space.low, space.low, np.zeros(size), space.high, space.high]
        np.testing.assert_allclose(seen, expected, atol=1e-7)


def random_bounds(rng: np.random.Generator) -> tuple[Any, Any]:
    """Bounds of 1 to 30 numbers from a hundred-thousandth to a million, mostly not symmetric."""
    size = int(rng.integers(1, 31))
    width = 10.0 ** rng.uniform(-5, 6, size)
    low = (rng.normal(size=size) * width * rng.integers(0, 3)).astype(np.float32)
    return low, (low + width).astype(np.float32)


def test_actions_stay_in_random_boxes(rng: np.random.Generator) -> None:
    """Inside whatever is put in; ends go to ends, the middle to the middle, and order is kept."""
    for _ in range(1_000):
        low, high = random_bounds(rng)
        assert (high > low).all()
        action = rng.normal(size=len(low)).astype(np.float32) * np.float32(2)
        scaled = to_env(action, low, high)
        assert scaled.dtype == np.float32
        assert (low <= scaled).all()
        assert (scaled <= high).all()
        slack = 4e-7 * np.maximum(np.abs(low), np.abs(high))
        ones = np.ones_like(low)
        assert np.array_equal(to_env(-ones, low, high), low)
        assert (np.abs(to_env(ones, low, high) - high) <= slack).all()
        assert np.array_equal(to_env(3 * ones, low, high), to_env(ones, low, high))
        middle = (low.astype(float) + high) / 2
        assert (np.abs(to_env(0 * ones, low, high) - middle) <= slack).all()
        inside = np.clip(action, -1, 1).astype(float)
        exact = low + (high.astype(float) - low) * (inside + 1) / 2
        assert (np.abs(scaled - exact) <= slack + 1e-6 * (high - low)).all()


def test_no_action_leaves_a_box_of_float64() -> None:
    """Bounds such as 0.1 lie between two float32 numbers; the env itself asserts what it gets."""
    env = world("broken_envs:Precise-v0")
    env.reset()
    for action in (-1, 1, 0.3):
        env.step(np.full(2, action, np.float32))
    box: Any = env.env.action_space
    np.testing.assert_allclose(env.low, box.low, rtol=1e-7)
    np.testing.assert_allclose(env.high, box.high, rtol=1e-7)


def test_an_episode_without_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pacesetter.envs.environment.MAX_EPISODE", 300)
    env = world("broken_envs:Endless-v0")
    with pytest.raises(TrainingError, match=r"not ended after 300 steps; .*max_episode_steps"):
        rollouts(lambda observation: np.zeros(2, np.float32), env, 1)
    limited = world("broken_envs:Endless-v0", max_episode_steps=250)
    assert rollouts(lambda observation: np.zeros(2, np.float32), limited, 2).lengths == [250, 250]


def test_widest_finite_box() -> None:
    """Bounds that float32 only just holds give no NaN."""
    high = np.full(2, np.finfo(np.float32).max)
    for action in (-1, 0, 0.5, 1):
        scaled = to_env(np.full(2, action, np.float32), -high, high)
        assert np.isfinite(scaled).all()


# Tasks and how many steps their episodes surely last.
REPEATABLE = {
    "HalfCheetah-v5": 400,
    "Ant-v5": 50,
    "Humanoid-v5": 12,
    "Walker2d-v5": 12,
    "pacesetter/Ant111-v4": 50,
}


@pytest.mark.parametrize("name", REPEATABLE)
def test_episode_is_entered_again(name: str, rng: np.random.Generator) -> None:
    """A new env goes on from a snapshot exactly as the old one does."""
    env, length = world(name), REPEATABLE[name]
    actions = rng.uniform(-0.3, 0.3, (2 * length, env.action_size)).astype(np.float32)
    for episode in range(3):
        env.reset()
        assert not any(env.step(action).ended for action in actions[: length - episode])
    snapshot = env.snapshot()
    assert (snapshot.episode, len(snapshot.actions)) == (2, length - 2)
    other = world(name)
    assert other.restore(snapshot)
    assert np.array_equal(other.observation, env.observation)
    for action in actions[length:]:
        one, two = env.step(action), other.step(action)
        assert np.array_equal(one.observation, two.observation)
        assert one[1:4] == two[1:4]
        if one.ended:
            break
    assert np.array_equal(env.reset(), other.reset())


def test_snapshot_of_another_seed_is_noticed() -> None:
    env, other = world("HalfCheetah-v5"), world("HalfCheetah-v5", seed=4)
    env.reset()
    env.step(np.zeros(6, np.float32))
    assert env.restore(env.snapshot())
    assert not other.restore(env.snapshot())


def test_an_episode_that_now_ends_at_its_last_action_is_noticed() -> None:
    """As where somebody has made the task's limit shorter since the snapshot."""
    actions = np.zeros((3, 6), np.float32)
    env, shorter = world("HalfCheetah-v5"), world("HalfCheetah-v5", max_episode_steps=3)
    env.reset()
    for action in actions:
        env.step(action)
    assert env.restore(env.snapshot())
    assert not shorter.restore(env.snapshot())


def test_starts_differ() -> None:
    """By seed, stream, member and episode."""
    keys = [(s, t, i, e) for s in range(3) for t in Stream for i in range(3) for e in range(20)]
    assert len({episode_seed(*key) for key in keys}) == len(keys)


def test_env_that_does_not_repeat_is_reported(runs: Any) -> None:
    """The run says so, starts a new episode, and goes on."""
    settings = {**TINY, "steps": 260, "warmup": 250, "name": "restless"}
    trainer = Trainer("td3", f"broken_envs:{Restless.__name__}-v0", runs=runs, **settings)
    run_to_step(trainer, 1)
    resumed = Trainer.resume(trainer.directory.path)
    general, note = resumed.notes
    assert "does not repeat an episode from its seed, so a resumed run differs" in general
    assert "env 0" in note
    assert "Restless-v0 does not repeat" in note
    assert "\n" not in note
    *_, last = resumed
    assert (last.step, resumed.finished) == (260, True)


def test_a_new_episode_has_nothing_of_the_one_that_does_not_repeat(runs: Any) -> None:
    """Not its return so far, nor the action that was chosen when the task's fault broke it off."""
    settings = {**TINY, "steps": 260, "warmup": 250, "normalize_reward": True}
    trainer = Trainer("td3", f"broken_envs:{Restless.__name__}-v0", runs=runs, **settings)
    for _ in range(5):
        trainer.loop.tick()
    trainer.loop.explorers[0].pending = np.zeros(1, np.float32)
    trainer.progress.acting = [0]
    trainer.save()
    trainer.close()
    resumed = Trainer.resume(trainer.directory.path)
    assert resumed.loop.explorers[0].pending is None
    resumed.loop.tick()
    explorer, returns = resumed.loop.explorers[0], resumed.loop.experience.return_scale
    resumed.close()
    assert len(explorer.env.actions) == 1
    assert returns.running[0] == explorer.env.earned


def test_env_that_remembers_earlier_episodes_is_reported(runs: Any) -> None:
    """The observations repeat, but what the episode earned does not."""
    settings = {**TINY, "steps": 260, "warmup": 260, "eval_every": 260, "renew_env": False}
    trainer = Trainer("td3", "broken_envs:Ageing-v0", runs=runs, **settings)
    run_to_step(trainer, 150)
    resumed = Trainer.resume(trainer.directory.path)
    resumed.close()
    general, note = resumed.notes
    assert "is kept from one episode to the next" in general
    assert "Ageing-v0 does not repeat" in note


def test_known_tasks() -> None:
    """Versions that only raise are not offered; the papers' Ant is."""
    names = known()
    assert {*SIZES} <= {*names}
    assert not [name for name in names if name.startswith(("Ant-", "Hopper-")) and name[-1] in "23"]


def test_env_keywords_reach_the_task() -> None:
    env = Recipe("Ant-v5", {"include_cfrc_ext_in_observation": False}).make()
    assert env.observation_space.shape == (27,)
    env.close()

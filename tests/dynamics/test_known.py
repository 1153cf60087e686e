"""Known rewards and ends of the walkers, along real trajectories of the simulator."""

from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from pacesetter.dynamics import known_rewards
from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError
from pacesetter.seeding import Stream

ENDLESS = ("HalfCheetah", "Swimmer")
# What an observation does not show: root mean square error of the speed, over its deviation.
SPEED_ERROR = {"HalfCheetah": 0.4, "Ant": 0.2, "Swimmer": 0.08, "": 0.05}


class Trajectory(NamedTuple):
    observation: Any
    action: Any
    following: Any
    reward: Any
    terminated: Any
    speed: Any  # by the way made, which observations do not show


def trajectory(name: str, steps: int) -> Trajectory:
    """Steps of actions that are held for a while, so that bodies get going and fall."""
    env, rng = Environment(Recipe(name), 0, Stream.REPORT), np.random.default_rng(4)
    columns: list[list[Any]] = [[] for _ in Trajectory._fields]
    env.reset()
    for i in range(steps):
        if i % 5 == 0:
            action = rng.uniform(-1.2, 1.2, env.action_size).astype(np.float32)
        before, step = env.observation, env.step(action)
        row = (before, action, step.observation, step.reward, step.terminated)
        for column, value in zip(columns, (*row, step.info["x_velocity"]), strict=True):
            column.append(value)
        if step.ended:
            env.reset()
    env.close()
    return Trajectory(*(np.array(column) for column in columns))


@pytest.mark.parametrize("name", known_rewards.TASKS)
def test_as_the_simulator_has_it(name: str) -> None:
    """Ends are the simulator's; of the reward, all but the speed is, to float32."""
    real = trajectory(name, 1_500 if "Ant" in name else 600)
    task, functions = known_rewards.TASKS[name], known_rewards.of(name)
    ended = jax.jit(functions.terminated)(real.following)
    np.testing.assert_array_equal(ended, real.terminated)
    assert real.terminated.any() == (not name.startswith(ENDLESS))
    speed = (task.speed(real.observation) + task.speed(real.following)) / 2
    found = jax.jit(functions.reward)(real.observation, real.action, real.following)
    rest = real.reward - task.speed_reward * real.speed
    np.testing.assert_allclose(found - task.speed_reward * speed, rest, atol=1e-5)
    error = np.sqrt(np.mean((speed - real.speed) ** 2)) / real.speed.std()
    assert error < next(bound for body, bound in SPEED_ERROR.items() if body in name)
    assert abs(np.mean(speed - real.speed)) < 0.03 * real.speed.std()


def test_leading_axes_are_free() -> None:
    """Members by rows, or a single transition: the same numbers."""
    real, functions = trajectory("Humanoid-v5", 60), known_rewards.of("Humanoid-v5")
    parts = real.observation, real.action, real.following
    flat = functions.reward(*parts)
    folded = functions.reward(*(x.reshape(3, 20, -1) for x in parts))
    np.testing.assert_allclose(folded.reshape(60), flat, rtol=1e-5)
    np.testing.assert_allclose(functions.reward(*(x[7] for x in parts)), flat[7], rtol=1e-5)
    assert functions.terminated(real.following[7]).shape == ()


def test_unknown_and_changed_tasks_are_refused() -> None:
    with pytest.raises(
        UsageError, match=r"reward of Hopper-v3 is not known.*Hopper-v4.*--no-known"
    ):
        known_rewards.of("Hopper-v3")
    with pytest.raises(UsageError, match="env_kwargs: ctrl_cost_weight may change the reward"):
        known_rewards.of("Ant-v5", {"max_episode_steps": 100, "ctrl_cost_weight": 0.1})
    assert known_rewards.of("Ant-v5", {"max_episode_steps": 100}) == known_rewards.of("Ant-v5")

"""Reward and termination of Gymnasium's walkers as functions of (s, a, s'), usable under `jit`.

Read off gymnasium/envs/mujoco/*_v4.py and *_v5.py. Everything is exact except what an observation
does not show: the forward speed, which is paid for the way made in a step (see docs/dynamics.md).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp

from pacesetter.dynamics.model import Known
from pacesetter.errors import UsageError
from pacesetter.networks.mlp import Array

See = Callable[[Array], Array]  # a number (...) that an observation (..., O) shows
HARMLESS = {"max_episode_steps", "render_mode", "width", "height", "camera_id", "camera_name"}


class Task(NamedTuple):
    """What a task pays for and when it ends."""

    speed: See
    control_cost: float  # of the squared action in the env's own units
    healthy: See = lambda observation: jnp.full(observation.shape[:-1], True)
    healthy_reward: float = 0.0
    pays_fall: bool = False  # v4 pays the healthy reward for the falling step too
    speed_reward: float = 1.0
    contact_cost: See = lambda observation: jnp.zeros(observation.shape[:-1])
    action_bound: float = 1.0

    def reward(self, observation: Array, action: Array, next_observation: Array) -> Array:
        """Reward (...) of a transition with an action in [-1, 1]."""
        speed = (self.speed(observation) + self.speed(next_observation)) / 2
        alive = jnp.logical_or(self.healthy(next_observation), self.pays_fall)
        cost = self.control_cost * jnp.sum((self.action_bound * jnp.clip(action, -1, 1)) ** 2, -1)
        paid = self.speed_reward * speed + self.healthy_reward * alive
        return paid - cost - self.contact_cost(next_observation)

    def terminated(self, next_observation: Array) -> Array:
        """Whether the task ends (...) where this observation was reached."""
        return jnp.logical_not(self.healthy(next_observation))


def of(env: str, env_kwargs: dict[str, Any] | None = None) -> Known:
    """Known functions of a task by its Gymnasium id; refuses unknown ids and changed tasks."""
    if env not in TASKS:
        raise UsageError(
            f"known: the reward of {env} is not known, only that of {', '.join(TASKS)}; give "
            "--no-known, and it is learned too"
        )
    if changed := set(env_kwargs or {}) - HARMLESS:
        raise UsageError(
            f"env_kwargs: {min(changed)} may change the reward, which is known of {env} as it is; "
            "leave it out, or give --no-known to learn the reward"
        )
    return Known(TASKS[env].reward, TASKS[env].terminated)


def _number(index: int, observation: Array) -> Array:
    return observation[..., index]


def _walker_healthy(observation: Array) -> Array:
    height, angle = observation[..., 0], observation[..., 1]
    return (height > 0.8) & (height < 2.0) & (jnp.abs(angle) < 1.0)


def _hopper_healthy(observation: Array) -> Array:
    upright = (observation[..., 0] > 0.7) & (jnp.abs(observation[..., 1]) < 0.2)
    return upright & (jnp.abs(observation[..., 1:]) < 100).all(axis=-1)


def _ant_healthy(observation: Array) -> Array:
    height = observation[..., 0]
    return jnp.isfinite(observation).all(axis=-1) & (height >= 0.2) & (height <= 1.0)


def _ant_contact_cost(observation: Array) -> Array:
    return 5e-4 * jnp.sum(observation[..., 27:] ** 2, axis=-1)


def _humanoid_healthy(observation: Array) -> Array:
    return (observation[..., 0] > 1.0) & (observation[..., 0] < 2.0)


def _humanoid_contact_cost(observation: Array) -> Array:
    return jnp.minimum(5e-7 * jnp.sum(observation[..., -78:] ** 2, axis=-1), 10)


def _momentum_speed(bodies: int, observation: Array) -> Array:
    """x-velocity of the centre of mass: momentum over mass, from every body's `cinert` and `cvel`.

    `cvel` is angular velocity and velocity at the root's centre of mass, `cinert` holds mass times
    the way from there, and the mass.
    """
    inertia = observation[..., 45 : 45 + 10 * bodies]
    velocity = observation[..., 45 + 10 * bodies : 45 + 16 * bodies]
    inertia = inertia.reshape(*inertia.shape[:-1], bodies, 10)
    velocity = velocity.reshape(*velocity.shape[:-1], bodies, 6)
    moment, mass = inertia[..., 6:9], inertia[..., 9]
    turning = velocity[..., 1] * moment[..., 2] - velocity[..., 2] * moment[..., 1]
    return (mass * velocity[..., 3] + turning).sum(axis=-1) / mass.sum(axis=-1)


_CHEETAH = Task(partial(_number, 8), control_cost=0.1)
_SWIMMER = Task(partial(_number, 3), control_cost=1e-4)
_WALKER = Task(partial(_number, 8), control_cost=1e-3, healthy=_walker_healthy, healthy_reward=1.0)
_HOPPER = Task(partial(_number, 5), control_cost=1e-3, healthy=_hopper_healthy, healthy_reward=1.0)
_ANT = Task(partial(_number, 13), control_cost=0.5, healthy=_ant_healthy, healthy_reward=1.0)
_HUMANOID = Task(
    partial(_momentum_speed, 13),
    control_cost=0.1,
    healthy=_humanoid_healthy,
    healthy_reward=5.0,
    speed_reward=1.25,
    action_bound=0.4,
)
TASKS = {
    "HalfCheetah-v4": _CHEETAH,
    "HalfCheetah-v5": _CHEETAH,
    "Swimmer-v4": _SWIMMER,
    "Swimmer-v5": _SWIMMER,
    "Walker2d-v4": _WALKER._replace(pays_fall=True),
    "Walker2d-v5": _WALKER,
    "Hopper-v4": _HOPPER._replace(pays_fall=True),
    "Hopper-v5": _HOPPER,
    "Ant-v4": _ANT._replace(pays_fall=True),
    "pacesetter/Ant111-v4": _ANT._replace(pays_fall=True),
    "Ant-v5": _ANT._replace(contact_cost=_ant_contact_cost),
    "Humanoid-v4": _HUMANOID._replace(speed=partial(_momentum_speed, 14), pays_fall=True),
    "Humanoid-v5": _HUMANOID._replace(contact_cost=_humanoid_contact_cost),
}

"""Imagined steps of a policy, as ME-TRPO takes them (Kurutach et al. 2018).

Axes: K members, E imagined episodes, M starts, O and A numbers of a state and of an action.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from pacesetter.batch import Batch
from pacesetter.dynamics.model import Dynamics, Models
from pacesetter.networks.mlp import Array
from pacesetter.networks.trust_region import Gaussian, distribution_of
from pacesetter.policy import OBSERVATION_LIMIT


@dataclass(frozen=True)
class Imagined:
    """Episodes of at most `horizon` steps in learned models."""

    dynamics: Dynamics
    gamma: float
    horizon: int
    envs: int  # episodes at a time (E)
    bootstrap: bool  # whether the value counts of where the horizon cuts an episode

    def rollout(self, models: Models, actor: Gaussian, starts: Array, key: Array) -> Batch:
        """Rows (horizon, E, ...) from starts (M, O), one model drawn for each step.

        Where an episode ends before the horizon, another begins; it is cut with the rest.
        """

        def some_starts(key: Array) -> Array:
            return starts[jax.random.randint(key, (self.envs,), 0, len(starts))]

        def step(observation: Array, key: Array) -> tuple[Array, Batch]:
            act_key, choice_key, model_key, start_key = jax.random.split(key, 4)
            mean, log_std = distribution_of(actor, observation)
            action = mean + jnp.exp(log_std) * jax.random.normal(act_key, mean.shape)
            chosen = jax.random.randint(choice_key, (), 0, self.dynamics.members)
            one = self.dynamics.choose(models, chosen)
            parts = self.transition(one, observation[None], action[None], model_key)
            next_observation, reward, terminated = (part[0] for part in parts)
            row = Batch(
                observation=observation,
                action=action,
                reward=reward,
                next_observation=next_observation,
                discount=self.gamma * (1.0 - terminated),
                last=1.0 * terminated,
                weight=jnp.ones(self.envs),
                mask=jnp.zeros((self.envs, 0)),
            )
            return jnp.where(terminated[:, None], some_starts(start_key), next_observation), row

        start_key, steps_key = jax.random.split(key)
        keys = jax.random.split(steps_key, self.horizon)
        _, batch = jax.lax.scan(step, some_starts(start_key), keys)
        if self.bootstrap:
            return batch
        return batch._replace(discount=batch.discount.at[-1].set(0))

    def returns(self, models: Models, actor: Gaussian, starts: Array) -> Array:
        """Mean return (K,) of the mean action in each model alone, from all starts (M, O)."""

        def step(carry: tuple[Array, Array], key: Array) -> tuple[Any, Array]:
            observation, running = carry
            action, _ = distribution_of(actor, observation)
            next_observation, reward, terminated = self.transition(models, observation, action, key)
            return (next_observation, running & ~terminated), running * reward

        observation = jnp.stack([starts] * self.dynamics.members)
        running = jnp.ones(observation.shape[:-1], bool)
        # The same noise for every policy, where the models have any.
        keys = jax.random.split(jax.random.key(0), self.horizon)
        _, rewards = jax.lax.scan(step, (observation, running), keys)
        return rewards.sum(axis=0).mean(axis=-1)

    def transition(
        self, models: Models, observation: Array, action: Array, key: Array
    ) -> tuple[Array, Array, Array]:
        """Next observation, reward and end of each member's own states (K, B, ...).

        Imagined states stay within ten deviations of the real ones.
        """
        dynamics, scale = self.dynamics, models.scale
        action = jnp.clip(action, -1, 1)
        size = dynamics.spec.observation_size
        mean, reach = scale.mean[:size], OBSERVATION_LIMIT * scale.deviation[:size]
        next_observation = dynamics.sample(models, observation, action, key)
        next_observation = jnp.clip(next_observation, mean - reach, mean + reach)
        reward = dynamics.reward(models, observation, action, next_observation).mean(axis=0)
        ends = dynamics.terminated(models, observation, action, next_observation)
        return next_observation, reward, ends > 0.5

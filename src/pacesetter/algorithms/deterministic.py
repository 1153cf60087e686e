"""What learners with a deterministic actor share: how they act, explore, smooth and copy."""

from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter.algorithms.contract import Array, Learner
from pacesetter.networks import exploration, mlp
from pacesetter.policy import Actors
from pacesetter.types import Floats, Layers


class DeterministicLearner(Learner):
    """Defaults for TD3 and its kin.

    Their states have `actor`, `target_actor` and `critic`, an optimiser state of each network that
    learns, `updates`, and `exploration`: what the exploration adapts, () for most kinds. Their
    settings have `exploration` and `exploration_noise`, and with `smoothed` those of target noise.
    """

    @cached_property
    def exploration(self) -> exploration.Exploration:
        """How it explores."""
        return exploration.KINDS[self.hyper.exploration]

    def smoothed(self, action: Array, key: Array) -> Array:
        """A target's actions (B, A) with clipped noise, drawn for each transition."""
        limit = self.hyper.target_noise_clip
        noise = self.hyper.target_noise * jax.random.normal(key, action.shape)
        return jnp.clip(action + jnp.clip(noise, -limit, limit), -1, 1)

    def policy_params(self, state: Any) -> tuple[mlp.Network, Any]:
        return state.actor, state.exploration

    def start_episode(self, params: Any, rng: np.random.Generator) -> Any:
        return self.exploration.start_episode(params, self.spec.action_size, rng)

    def act(
        self, params: Any, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        scale = self.hyper.exploration_noise
        return self.exploration.act(params, noise_state, observation, scale, rng)

    def policy(self, state: Any) -> Actors:
        actor, _ = self.policy_params(state)
        one = jax.tree.map(lambda x: x[None], actor)
        return Actors(one, activation="relu", output="tanh")

    def with_actor(self, state: Any, layers: Layers) -> Any:
        actor = mlp.replaced(state.actor, layers)
        return state._replace(actor=actor, target_actor=jax.tree.map(jnp.copy, actor))

    def blinded(self, state: Any, seen: Any) -> Any:
        actor, target_actor = state.actor, state.target_actor
        return state._replace(
            actor=mlp.blinded(actor, seen), target_actor=mlp.blinded(target_actor, seen)
        )

    def copy_weights(self, own: Any, parent: Any) -> Any:
        return parent._replace(
            actor_opt_state=own.actor_opt_state,
            critic_opt_state=own.critic_opt_state,
            updates=own.updates,
        )

    def copy_actor(self, own: Any, parent: Any) -> Any:
        return own._replace(
            actor=parent.actor,
            target_actor=parent.actor,
            actor_opt_state=jax.tree.map(jnp.zeros_like, own.actor_opt_state),
            exploration=parent.exploration,
        )

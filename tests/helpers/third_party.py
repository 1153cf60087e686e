"""An algorithm as somebody else would bring it, in one file: DDPG without any target network."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import Array, Learner, Update
from pacesetter.batch import Batch, Spec
from pacesetter.networks import mlp
from pacesetter.networks.forward import forward
from pacesetter.policy import Actors
from pacesetter.settings import STRICT, OffPolicy
from pacesetter.settings.values import Width
from pacesetter.types import Floats


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(OffPolicy):
    """Its own settings, on top of those of every learner with a replay."""

    width: Width = Field(64, description="units of the one hidden layer")
    learning_rate: float = Field(3e-3, gt=0, description="Adam step of both networks")
    noise: float = Field(0.5, ge=0, description="deviation of the noise on actions")


class State(NamedTuple):
    """One learner."""

    actor: mlp.Network
    critic: mlp.Network
    actor_opt_state: Any
    critic_opt_state: Any
    updates: Array


@dataclass(frozen=True)
class Plain(Learner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Hyper

    def init(self, key: Array) -> State:
        (observation, action), hidden = self.spec, (self.hyper.width,)
        actor_key, critic_key = jax.random.split(key)
        actor = mlp.init(actor_key, observation, hidden, action)
        critic = mlp.init(critic_key, observation + action, hidden, 1)
        moments = self._adam.init(actor), self._adam.init(critic)
        return State(actor, critic, *moments, jnp.zeros((), jnp.int32))

    def policy_params(self, state: State) -> mlp.Network:
        return state.actor

    def act(
        self, params: Any, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        action = np.tanh(forward(params, observation))
        noise = rng.standard_normal(action.shape, np.float32)
        return action + np.float32(self.hyper.noise) * noise, noise_state

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        rows = jax.tree.map(lambda x: x[0], batch)
        following = mlp.actor(state.actor, rows.next_observation)
        value = mlp.outputs(state.critic, rows.next_observation, following)[..., 0]
        y = jax.lax.stop_gradient(rows.reward + rows.discount * value)

        def critic_loss(critic: mlp.Network) -> tuple[Array, Array]:
            error = mlp.outputs(critic, rows.observation, rows.action)[..., 0] - y
            return (rows.weight * error**2).mean(), jnp.abs(error)

        (loss, error), slope = jax.value_and_grad(critic_loss, has_aux=True)(state.critic)
        critic, critic_moments = mlp.apply_gradient(
            self._adam, state.critic, slope, state.critic_opt_state
        )

        def actor_loss(actor: mlp.Network) -> Array:
            action = mlp.actor(actor, rows.observation)
            return -mlp.outputs(critic, rows.observation, action)[..., 0].mean()

        lack, slope = jax.value_and_grad(actor_loss)(state.actor)
        actor, actor_moments = mlp.apply_gradient(
            self._adam, state.actor, slope, state.actor_opt_state
        )
        state = State(actor, critic, actor_moments, critic_moments, state.updates + 1)
        return Update(state, {"critic_loss": loss, "actor_loss": lack}, error[None])

    def ledger(self, states: Any, updates: int, actions: int) -> dict[str, int]:
        return {"plain_updates": updates}

    def copy_weights(self, own: State, parent: State) -> State:
        return parent._replace(
            actor_opt_state=own.actor_opt_state,
            critic_opt_state=own.critic_opt_state,
            updates=own.updates,
        )

    def copy_actor(self, own: State, parent: State) -> State:
        return own._replace(actor=parent.actor, actor_opt_state=self._adam.init(parent.actor))

    def policy(self, state: State) -> Actors:
        one = jax.tree.map(lambda x: x[None], state.actor)
        return Actors(one, activation="relu", output="tanh")

    @property
    def _adam(self) -> optax.GradientTransformation:
        return optax.adam(self.hyper.learning_rate)

"""TD3 (Fujimoto et al. 2018), one member. Reference: sfujim/TD3, TD3.py at 34770cc.

for each of `policy_delay` minibatches:
    y = r + discount * min_i target_critic_i(s', target_actor(s') + clipped noise)
    move every critic towards y
move the actor up critic 1 on the last minibatch
move all targets a little towards their networks
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter import nets
from pacesetter.algorithm import NO_MASK, Array, Batch, Spec, Update
from pacesetter.config import STRICT, LearningRate, OffPolicy, Switch, Tau, Tune, Width
from pacesetter.exploration import KINDS
from pacesetter.policy import Actors, Floats, Layers, forward

UNROLLED = 4  # critic steps a loop; without one, XLA need not copy states between iterations


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(OffPolicy):
    """Defaults are the reference repository's; lengths of noise are in actions of [-1, 1]."""

    hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of hidden layers"
    )
    actor_learning_rate: LearningRate = Field(3e-4, gt=0, description="Adam step of the actor")
    critic_learning_rate: LearningRate = Field(3e-4, gt=0, description="Adam step of the critics")
    tau: Tau = Field(0.005, gt=0, le=1, description="share of the network in a target update")
    critics: int = Field(2, ge=1, description="critics whose minimum is the target")
    policy_delay: Annotated[int, Tune(1, 4)] = Field(
        2, ge=1, description="critic updates an actor update"
    )
    target_noise: Annotated[float, Tune(0.1, 0.4)] = Field(
        0.2, ge=0, description="deviation of the target action's noise"
    )
    target_noise_clip: float = Field(0.5, ge=0, description="bound of the target action's noise")
    exploration: Literal["gaussian", "ou"] = Field("gaussian", description="noise on actions")
    exploration_noise: Annotated[float, Tune(0.05, 0.4, log=True)] = Field(
        0.1, ge=0, description="deviation of that noise"
    )
    critic_layer_norm: Switch = Field(False, description="layer norm before each critic ReLU")
    actor_layer_norm: Switch = Field(False, description="layer norm before each actor ReLU")


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: nets.Network
    critic: nets.Network
    target_actor: nets.Network
    target_critic: nets.Network
    actor_optimizer: Any
    critic_optimizer: Any
    updates: Array


@dataclass(frozen=True)
class TD3:
    """The learner of one member; `action_layer`, decay and output bound are DDPG's to set."""

    spec: Spec
    hyper: Hyper
    action_layer: int = 0
    critic_decay: float = 0.0
    output_bound: float | None = None

    @property
    def cycle(self) -> int:
        return self.hyper.policy_delay

    def mask(self, rng: np.random.Generator) -> Floats:
        return NO_MASK

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = self._new_actor(actor_key)
        critic = jax.vmap(self._new_critic)(jax.random.split(critic_key, self.hyper.critics))
        return State(
            actor=actor,
            critic=critic,
            target_actor=jax.tree.map(jnp.copy, actor),
            target_critic=jax.tree.map(jnp.copy, critic),
            actor_optimizer=self._actor_adam.init(actor),
            critic_optimizer=self._critic_adam.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def acting(self, state: State) -> nets.Network:
        return state.actor

    def begin(self, acting: Layers, rng: np.random.Generator) -> Any:
        return KINDS[self.hyper.exploration].begin(self.spec.action_size)

    def act(
        self, acting: Layers, memory: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        explore = KINDS[self.hyper.exploration].noise
        noise, memory = explore(memory, self.hyper.exploration_noise, self.spec.action_size, rng)
        return np.tanh(forward(acting, observation)) + noise, memory

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        def critic_step(state: State, inputs: tuple[Batch, Array]) -> tuple[State, Any]:
            minibatch, step_key = inputs
            y = self.target(state, minibatch, step_key)
            state, loss, error = self.fit_critic(state, minibatch, y, minibatch.weight)
            return state, (loss, error)

        steps = (batch, jax.random.split(key, self.cycle))
        state, (losses, error) = jax.lax.scan(
            critic_step, state, steps, unroll=min(self.cycle, UNROLLED)
        )
        state, actor_loss = self.fit_actor(state, jax.tree.map(lambda x: x[-1], batch))
        return Update(state, {"critic_loss": losses.mean(), "actor_loss": actor_loss}, error)

    def ledger(self, updates: int, actions: int) -> dict[str, int]:
        return {}

    def policy(self, state: State) -> Actors:
        one = jax.tree.map(lambda x: x[None], state.actor)
        return Actors(one, activation="relu", output="tanh")

    # The pieces that `update` composes.

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Clipped double-Q target y (B,); one noise draw a sample, shared by the critics."""
        limit = self.hyper.target_noise_clip
        noise = self.hyper.target_noise * jax.random.normal(key, batch.action.shape)
        clean = nets.actor(state.target_actor, batch.next_observation)
        action = jnp.clip(clean + jnp.clip(noise, -limit, limit), -1, 1)
        values = self.values(state.target_critic, batch.next_observation, action)
        return jax.lax.stop_gradient(batch.reward + batch.discount * values.min(axis=0))

    def values(self, critic: nets.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B)."""
        return nets.critics(critic, observation, action, self.action_layer)

    def fit_critic(
        self, state: State, batch: Batch, y: Array, weight: Array
    ) -> tuple[State, Array, Array]:
        """One Adam step of all critics towards y; the loss and each row's largest |error| (B,)."""

        def loss(critic: nets.Network) -> tuple[Array, Array]:
            error = self.values(critic, batch.observation, batch.action) - y
            return (weight * error**2).mean(axis=1).sum(), jnp.abs(error).max(axis=0)

        (value, error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        critic, optimizer = nets.descend(
            self._critic_adam, state.critic, gradient, state.critic_optimizer
        )
        state = state._replace(critic=critic, critic_optimizer=optimizer, updates=state.updates + 1)
        return state, value, error

    def fit_actor(self, state: State, batch: Batch) -> tuple[State, Array]:
        """One Adam step of the actor up critic 1, then one soft step of all targets."""
        first = jax.tree.map(lambda x: x[0], state.critic)

        def loss(actor: nets.Network) -> Array:
            action = nets.actor(actor, batch.observation)
            return -nets.critic(first, batch.observation, action, self.action_layer).mean()

        value, gradient = jax.value_and_grad(loss)(state.actor)
        actor, optimizer = nets.descend(
            self._actor_adam, state.actor, gradient, state.actor_optimizer
        )
        soften: Callable[..., Any] = partial(optax.incremental_update, step_size=self.hyper.tau)
        state = state._replace(
            actor=actor,
            actor_optimizer=optimizer,
            target_actor=soften(actor, state.target_actor),
            target_critic=soften(state.critic, state.target_critic),
        )
        return state, value

    def _new_actor(self, key: Array) -> nets.Network:
        sizes = (self.spec.observation_size, self.hyper.hidden, self.spec.action_size)
        norm = self.hyper.actor_layer_norm
        return nets.init(key, *sizes, layer_norm=norm, output_bound=self.output_bound)

    def _new_critic(self, key: Array) -> nets.Network:
        return nets.init(
            key,
            self.spec.observation_size,
            self.hyper.hidden,
            1,
            layer_norm=self.hyper.critic_layer_norm,
            output_bound=self.output_bound,
            joins=(self.action_layer, self.spec.action_size),
        )

    @property
    def _actor_adam(self) -> optax.GradientTransformation:
        return optax.adam(self.hyper.actor_learning_rate)

    @property
    def _critic_adam(self) -> optax.GradientTransformation:
        decay = [optax.add_decayed_weights(self.critic_decay)] if self.critic_decay else []
        return optax.chain(*decay, optax.adam(self.hyper.critic_learning_rate))


build = TD3

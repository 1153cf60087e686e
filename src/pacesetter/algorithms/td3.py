"""TD3 (Fujimoto et al. 2018), one member. Reference: sfujim/TD3, TD3.py at 34770cc.

for each of `policy_delay` minibatches:
    target_q = r + discount * min_i target_critic_i(s', target_actor(s') + clipped noise)
    move every critic towards target_q
move the actor up critic 1 on the last minibatch
move all targets a little towards their networks
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import Array, Update, each_minibatch, last_minibatch
from pacesetter.algorithms.deterministic import DeterministicLearner
from pacesetter.batch import Batch, Spec
from pacesetter.networks import critic_heads, mlp
from pacesetter.networks.exploration import Kind, adapt
from pacesetter.settings import STRICT, ActorCritic
from pacesetter.settings.values import Tune


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(ActorCritic):
    """Defaults are the reference repository's; noise is in units of actions in [-1, 1]."""

    policy_delay: Annotated[int, Tune(1, 4)] = Field(
        2, ge=1, le=1_000, description="critic updates per actor update"
    )
    target_noise: Annotated[float, Tune(0.1, 0.4)] = Field(
        0.2, ge=0, description="standard deviation of the target action's noise"
    )
    target_noise_clip: float = Field(0.5, ge=0, description="bound of the target action's noise")
    exploration: Kind = Field("gaussian", description="noise on actions, or on the actor's weights")
    exploration_noise: Annotated[float, Tune(0.05, 0.4, log=True)] = Field(
        0.1, ge=0, description="standard deviation of that noise, measured on actions"
    )


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: mlp.Network
    critic: mlp.Network
    target_actor: mlp.Network
    target_critic: mlp.Network
    actor_opt_state: Any
    critic_opt_state: Any
    updates: Array
    exploration: Any  # what the exploration adapts, () for most kinds


@dataclass(frozen=True)
class TD3(DeterministicLearner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any

    @cached_property
    def head(self) -> critic_heads.Head:
        """What the critics' outputs mean."""
        return critic_heads.choose(self.hyper.quantiles, self.hyper.replay)

    @property
    def updates_per_call(self) -> int:
        return self.hyper.policy_delay

    @property
    def critic_count(self) -> int:
        """How many critics there are."""
        return self.hyper.critics

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = self.new_actor(actor_key)
        critic = jax.vmap(self.new_critic)(jax.random.split(critic_key, self.critic_count))
        return State(
            actor=actor,
            critic=critic,
            target_actor=jax.tree.map(jnp.copy, actor),
            target_critic=jax.tree.map(jnp.copy, critic),
            actor_opt_state=self.actor_optimizer.init(actor),
            critic_opt_state=self.critic_optimizer.init(critic),
            updates=jnp.zeros((), jnp.int32),
            exploration=self.exploration.init(self.hyper.exploration_noise),
        )

    # One update.

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        keys = jax.random.split(key, self.hyper.policy_delay + 1)
        state, (losses, td_error) = each_minibatch(self.critic_step, state, batch, keys[:-1])
        last = last_minibatch(batch)
        state, actor_loss = self.fit_actor(state, last)
        state = self.update_targets(state)
        losses = {name: loss.mean() for name, loss in losses.items()} | {"actor_loss": actor_loss}
        if self.exploration.adapts:
            state, losses["sigma"] = adapt(self, state, last.observation, keys[-1])
        return Update(state, losses, td_error)

    def critic_step(self, state: State, batch: Batch, key: Array) -> tuple[State, Any]:
        """Move every critic towards the target of one minibatch."""
        target_q = self.target(state, batch, key)
        state, loss, td_error = self.fit_critic(state, batch, target_q, batch.weight)
        return state, ({"critic_loss": loss}, td_error)

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Clipped double-Q target (B,), of quantiles (M, B)."""
        action = self.next_action(state, batch.next_observation, key)
        next_q = self.head.min_q(self.outputs(state.target_critic, batch.next_observation, action))
        return jax.lax.stop_gradient(batch.reward + batch.discount * next_q)

    def next_action(self, state: State, observation: Array, key: Array) -> Array:
        """The target actor's action (B, A) with clipped noise, drawn for each transition."""
        return self.smoothed(mlp.actor(state.target_actor, observation), key)

    def fit_critic(
        self, state: State, batch: Batch, target_q: Array, weight: Array
    ) -> tuple[State, Array, Array]:
        """One Adam step of all critics; the loss and each transition's largest |TD error| (B,)."""

        def loss(critic: mlp.Network) -> tuple[Array, Array]:
            outputs = self.outputs(critic, batch.observation, batch.action)
            return self.head.weighted_loss(outputs, target_q, weight)

        (value, td_error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        critic, opt_state = mlp.apply_gradient(
            self.critic_optimizer, state.critic, gradient, state.critic_opt_state
        )
        state = state._replace(critic=critic, critic_opt_state=opt_state, updates=state.updates + 1)
        return state, value, td_error

    def fit_actor(
        self, state: State, batch: Batch, weight: Array | float = 1.0
    ) -> tuple[State, Array]:
        """One Adam step of the actor up its objective."""

        def loss(actor: mlp.Network) -> Array:
            action = mlp.actor(actor, batch.observation)
            return -(weight * self.actor_value(state.critic, batch.observation, action)).mean()

        value, gradient = jax.value_and_grad(loss)(state.actor)
        actor, opt_state = mlp.apply_gradient(
            self.actor_optimizer, state.actor, gradient, state.actor_opt_state
        )
        return state._replace(actor=actor, actor_opt_state=opt_state), value

    def update_targets(self, state: State) -> State:
        """One soft update of all targets."""
        soft_update = partial(optax.incremental_update, step_size=self.hyper.tau)
        return state._replace(
            target_actor=soft_update(state.actor, state.target_actor),
            target_critic=soft_update(state.critic, state.target_critic),
        )

    def actor_value(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """The value (B,) that the actor climbs: in TD3 the first critic's."""
        one = jax.tree.map(lambda x: x[0], critic)
        return self.head.value(self.critic_network(one, observation, action))

    # Its networks.

    @cached_property
    def critic_network(self) -> Callable[[mlp.Network, Array, Array], Array]:
        """The outputs (B, M) of one critic for observations and actions."""
        return mlp.outputs

    def outputs(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's outputs (critics, B, M)."""
        return mlp.each(self.critic_network, critic, observation, action)

    def values(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B)."""
        return self.head.value(self.outputs(critic, observation, action))

    def new_actor(self, key: Array) -> mlp.Network:
        (observation, action), hyper = self.spec, self.hyper
        norm = hyper.actor_layer_norm
        return mlp.init(key, observation, hyper.hidden, action, layer_norm=norm)

    def new_critic(self, key: Array) -> mlp.Network:
        hyper, norm = self.hyper, self.hyper.critic_layer_norm
        return mlp.init(key, sum(self.spec), hyper.hidden, self.head.outputs, layer_norm=norm)

    @cached_property
    def actor_optimizer(self) -> optax.GradientTransformation:
        return optax.adam(self.hyper.actor_learning_rate)

    @cached_property
    def critic_optimizer(self) -> optax.GradientTransformation:
        return optax.adam(self.hyper.critic_learning_rate)

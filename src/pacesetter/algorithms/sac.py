"""SAC with a learned temperature (Haarnoja et al. 2018b), one member. Reference: rlkit, SB3 sac.py.

    target_q = r + discount * (min_i target_critic_i(s', a') - alpha * log pi(a'|s')), a' ~ pi(s')
    move every critic towards target_q
    move the actor up min_i critic_i(s, a) - alpha * log pi(a|s),  a ~ pi(s), on the moved critics
    move alpha towards the target entropy; move the critics' targets a little towards them

alpha is everywhere the one from before its own step, and actions stay in [-1, 1], so the target
entropy refers to that box.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import Array, Update
from pacesetter.algorithms.stochastic import Exploration, StochasticLearner
from pacesetter.batch import Batch, Spec
from pacesetter.networks import critic_heads, gaussian, mlp
from pacesetter.policy import Actors
from pacesetter.settings import STRICT, ActorCritic
from pacesetter.settings.values import LearningRate, Warmup

NEXT_Q = 1  # what is folded into a target's key for `next_q`; the action has the key itself


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(ActorCritic):
    """Defaults as in the paper's second version; warm-up is uniform, as in Spinning Up."""

    warmup: Warmup = Field(
        10_000, ge=0, description="env steps of uniformly random actions at the start, all members"
    )
    alpha_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam learning rate of the log temperature"
    )
    initial_alpha: float = Field(1.0, gt=0, description="temperature at the start")
    target_entropy: float | None = Field(None, description="in nats; default minus the action size")
    exploration: Exploration = Field(
        "policy", description="fixed: the stochastic policy explores by itself"
    )


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: mlp.Network
    critic: mlp.Network
    target_critic: mlp.Network
    log_alpha: Array
    actor_opt_state: Any
    critic_opt_state: Any
    alpha_opt_state: Any
    updates: Array


@dataclass(frozen=True)
class SAC(StochasticLearner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any

    @cached_property
    def head(self) -> critic_heads.Head:
        """What the critics' outputs mean."""
        return critic_heads.choose(self.hyper.quantiles, self.hyper.replay)

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        observation, action = self.spec
        hyper = self.hyper
        actor = mlp.init(
            actor_key, observation, hyper.hidden, 2 * action, layer_norm=hyper.actor_layer_norm
        )
        critic = jax.vmap(self._new_critic)(jax.random.split(critic_key, hyper.critics))
        log_alpha = jnp.log(jnp.asarray(hyper.initial_alpha, jnp.float32))
        return State(
            actor=actor,
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),
            log_alpha=log_alpha,
            actor_opt_state=optax.adam(hyper.actor_learning_rate).init(actor),
            critic_opt_state=optax.adam(hyper.critic_learning_rate).init(critic),
            alpha_opt_state=optax.adam(hyper.alpha_learning_rate).init(log_alpha),
            updates=jnp.zeros((), jnp.int32),
        )

    # One update.

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        critic_key, actor_key = jax.random.split(key)
        minibatch = jax.tree.map(lambda x: x[0], batch)
        state, (critic_loss, td_error) = self.critic_step(state, minibatch, critic_key)
        state, losses = self.fit_actor(state, minibatch, actor_key)
        return Update(state, {"critic_loss": critic_loss, **losses}, td_error[None])

    def critic_step(self, state: State, batch: Batch, key: Array) -> tuple[State, Any]:
        """Move every critic towards the target of one minibatch, and their targets after them."""
        target_q = self.target(state, batch, key)
        state, loss, td_error = self.fit_critic(state, batch, target_q, batch.weight)
        return state, (loss, td_error)

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Soft target (B,), of quantiles (M, B)."""
        action, bonus = self.next_action(state, batch.next_observation, key)
        outputs = mlp.each(mlp.outputs, state.target_critic, batch.next_observation, action)
        next_q = self.next_q(outputs, jax.random.fold_in(key, NEXT_Q)) + bonus
        return jax.lax.stop_gradient(batch.reward + batch.discount * next_q)

    def next_q(self, outputs: Array, key: Array) -> Array:
        """The next value (B,), of quantiles (M, B), from all target critics' outputs.

        Learners that choose among the critics at random have a key of their own for it.
        """
        return self.head.min_q(outputs)

    def actor_value(self, values: Array) -> Array:
        """The value (B,) that the actor climbs, from all critics' values (critics, B)."""
        return critic_heads.min_q(values)

    def next_action(self, state: State, observation: Array, key: Array) -> tuple[Array, Array]:
        """The target's action (B, A), and its entropy bonus (B,)."""
        action, log_prob = gaussian.sample(state.actor, observation, key)
        return action, -jnp.exp(state.log_alpha) * log_prob

    def values(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B)."""
        return self.head.value(mlp.each(mlp.outputs, critic, observation, action))

    def fit_critic(
        self, state: State, batch: Batch, target_q: Array, weight: Array
    ) -> tuple[State, Array, Array]:
        """One Adam step of all critics, one soft update of their targets; loss, |TD error| (B,)."""

        def loss(critic: mlp.Network) -> tuple[Array, Array]:
            outputs = mlp.each(mlp.outputs, critic, batch.observation, batch.action)
            return self.head.weighted_loss(outputs, target_q, weight)

        (value, td_error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        adam = optax.adam(self.hyper.critic_learning_rate)
        critic, opt_state = mlp.apply_gradient(adam, state.critic, gradient, state.critic_opt_state)
        state = state._replace(
            critic=critic,
            critic_opt_state=opt_state,
            target_critic=optax.incremental_update(critic, state.target_critic, self.hyper.tau),
            updates=state.updates + 1,
        )
        return state, value, td_error

    def fit_actor(
        self, state: State, batch: Batch, key: Array, weight: Array | float = 1.0
    ) -> tuple[State, dict[str, Array]]:
        """One Adam step of the actor on the given critics, and one of the temperature."""
        alpha = jnp.exp(state.log_alpha)

        def loss(actor: mlp.Network) -> tuple[Array, Array]:
            action, log_prob = gaussian.sample(actor, batch.observation, key)
            value = self.actor_value(self.values(state.critic, batch.observation, action))
            return (weight * (alpha * log_prob - value)).mean(), (weight * log_prob).mean()

        (value, log_prob), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        adam = optax.adam(self.hyper.actor_learning_rate)
        actor, opt_state = mlp.apply_gradient(adam, state.actor, gradient, state.actor_opt_state)
        state = state._replace(actor=actor, actor_opt_state=opt_state)
        losses = {"actor_loss": value, "alpha": alpha, "entropy": -log_prob}
        return self.fit_temperature(state, log_prob, jnp.mean(weight)), losses

    # How it acts.

    def policy_params(self, state: State) -> mlp.Network:
        return state.actor

    def policy(self, state: State) -> Actors:
        return gaussian.mean_policy(state.actor, self.spec.action_size)

    def _new_critic(self, key: Array) -> mlp.Network:
        inputs = self.spec.observation_size + self.spec.action_size
        return mlp.init(
            key,
            inputs,
            self.hyper.hidden,
            self.head.outputs,
            layer_norm=self.hyper.critic_layer_norm,
        )

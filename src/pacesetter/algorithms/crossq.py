"""CrossQ (Bhatt et al. 2024), one member. Reference: adityab/CrossQ, sbx/sac at 2811ad1.

SAC without target networks, whose networks batch-renormalise the input of every layer:

for each of `policy_delay` minibatches:
    one pass of every critic over (s, a) and (s', a') together, a' ~ pi(s')
    target_q = r + discount * (min_i critic_i(s', a') - alpha * log pi(a'|s')), without gradient
    move every critic towards target_q at (s, a)
move the actor up min_i critic_i(s, a) - alpha * log pi(a|s) on the last minibatch
move alpha towards the target entropy

Networks that learn normalise by their batch and move their running statistics; elsewhere they are
plain networks, into whose weights the running statistics are folded.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import Array, Learner, Update, each_minibatch, last_minibatch
from pacesetter.algorithms.stochastic import Exploration, StochasticLearner
from pacesetter.batch import Batch, Spec
from pacesetter.networks import batch_renorm, critic_heads, gaussian, mlp
from pacesetter.policy import Actors
from pacesetter.settings import STRICT, OffPolicy, check_loss
from pacesetter.settings.values import LARGEST_COUNTED, Count, LearningRate, Warmup, Width


def _check_bins(bins: int, info: ValidationInfo) -> int:
    if bins == 1:
        raise ValueError("one bin cannot tell returns apart; 0, or at least 2")
    return check_loss(bins, info)


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(OffPolicy):
    """Defaults are the paper's; `crossq-small` has critics as narrow as the actor."""

    warmup: Warmup = Field(
        5_000, ge=0, description="env steps of uniformly random actions at the start, all members"
    )
    hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of the actor's hidden layers"
    )
    critic_hidden: tuple[Width, ...] = Field(
        (2048, 2048), min_length=1, description="widths of the critics' hidden layers"
    )
    actor_learning_rate: LearningRate = Field(
        1e-3, gt=0, description="Adam learning rate of the actor"
    )
    critic_learning_rate: LearningRate = Field(
        1e-3, gt=0, description="Adam learning rate of the critics"
    )
    alpha_learning_rate: float = Field(
        1e-3, gt=0, description="Adam learning rate of the log temperature"
    )
    adam_momentum: float = Field(0.5, ge=0, lt=1, description="Adam's beta1 for actor and critics")
    initial_alpha: float = Field(1.0, gt=0, description="temperature at the start")
    target_entropy: float | None = Field(None, description="in nats; default minus the action size")
    critics: int = Field(2, ge=1, le=100, description="critics; the target uses their minimum")
    policy_delay: int = Field(3, ge=1, le=1_000, description="critic updates per actor update")
    renorm_after: Count = Field(
        100_000,
        ge=0,
        le=LARGEST_COUNTED,
        description="updates of a network with plain batch norm before batch renorm begins",
    )
    weight_norm: bool = Field(
        False,
        description="divide the weights into each hidden unit by their L2 norm after each update",
    )
    next_batch_gradient: bool = Field(
        True, description="let gradients flow through (s', a') in the batch statistics"
    )
    bins: Annotated[int, AfterValidator(_check_bins)] = Field(
        0,
        ge=0,
        le=1_001,
        description="bins of the return distribution that each critic learns, usually 51; "
        "rewards are then divided by the running standard deviation of discounted"
        " returns; 0 learns only the mean",
    )
    exploration: Exploration = Field(
        "policy", description="fixed: the stochastic policy explores by itself"
    )

    @property
    def scales_rewards(self) -> bool:
        return self.normalize_reward or self.bins > 0


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`. Networks hold their statistics."""

    actor: mlp.Network
    critic: mlp.Network
    log_alpha: Array
    actor_opt_state: Any
    critic_opt_state: Any
    alpha_opt_state: Any
    updates: Array


@dataclass(frozen=True)
class CrossQ(StochasticLearner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any

    @property
    def updates_per_call(self) -> int:
        return self.hyper.policy_delay

    @cached_property
    def head(self) -> critic_heads.Head:
        """What the critics' outputs mean."""
        if self.hyper.bins:
            return critic_heads.categorical(self.hyper.bins)
        return critic_heads.choose(0, self.hyper.replay)

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        (observation, action), hyper = self.spec, self.hyper
        actor = self._unit_length(
            batch_renorm.init(actor_key, observation, hyper.hidden, 2 * action)
        )
        new_critic = partial(
            batch_renorm.init, inputs=observation + action, hidden=hyper.critic_hidden
        )
        critic = self._unit_length(
            jax.vmap(partial(new_critic, outputs=self.head.outputs))(
                jax.random.split(critic_key, hyper.critics)
            )
        )
        log_alpha = jnp.log(jnp.asarray(hyper.initial_alpha, jnp.float32))
        return State(
            actor=actor,
            critic=critic,
            log_alpha=log_alpha,
            actor_opt_state=self._adam(hyper.actor_learning_rate).init(actor),
            critic_opt_state=self._adam(hyper.critic_learning_rate).init(critic),
            alpha_opt_state=optax.adam(hyper.alpha_learning_rate).init(log_alpha),
            updates=jnp.zeros((), jnp.int32),
        )

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        keys = jax.random.split(key, self.updates_per_call + 1)
        state, (critic_loss, td_error) = each_minibatch(self.fit_critic, state, batch, keys[:-1])
        state, losses = self.fit_actor(state, last_minibatch(batch), keys[-1])
        return Update(state, {"critic_loss": critic_loss.mean(), **losses}, td_error)

    def policy_params(self, state: State) -> mlp.Network:
        return batch_renorm.fold(state.actor)

    with_actor = Learner.with_actor  # a policy file holds its batch norm folded into the layers

    def policy(self, state: State) -> Actors:
        return gaussian.mean_policy(batch_renorm.fold(state.actor), self.spec.action_size)

    def values(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B), by its running statistics."""
        folded = jax.vmap(batch_renorm.fold)(critic)
        return self.head.value(mlp.each(mlp.outputs, folded, observation, action))

    # The pieces that `update` composes.

    def fit_critic(self, state: State, batch: Batch, key: Array) -> tuple[State, Any]:
        """One Adam step of all critics, with the target from the same pass; loss, |TD error|."""
        next_action, log_prob = gaussian.sample(
            batch_renorm.fold(state.actor), batch.next_observation, key
        )
        halves = (
            jnp.concatenate([batch.observation, batch.action], axis=-1),
            jnp.concatenate([batch.next_observation, next_action], axis=-1),
        )
        if self.hyper.next_batch_gradient:
            train, inputs = batch_renorm.train, (jnp.concatenate(halves),)
        else:
            train, inputs = batch_renorm.train_beside, halves
        forward = partial(train, warm=state.updates >= self.hyper.renorm_after)

        def loss(critic: mlp.Network) -> tuple[Array, Any]:
            outputs, trained = mlp.each(forward, critic, *inputs)
            now, later = jnp.split(outputs, 2, axis=1)
            bonus = -(jnp.exp(state.log_alpha) * log_prob)
            target_q = self.head.target(later, batch.reward, batch.discount, bonus)
            target_q = jax.lax.stop_gradient(target_q)
            value, td_error = self.head.weighted_loss(now, target_q, batch.weight)
            return value, (td_error, trained)

        (value, (td_error, trained)), gradient = jax.value_and_grad(loss, has_aux=True)(
            state.critic
        )
        adam = self._adam(self.hyper.critic_learning_rate)
        critic, opt_state = mlp.apply_gradient(adam, state.critic, gradient, state.critic_opt_state)
        critic = self._unit_length(critic)
        state = state._replace(
            critic=batch_renorm.with_statistics(critic, trained),
            critic_opt_state=opt_state,
            updates=state.updates + 1,
        )
        return state, (value, td_error)

    def fit_actor(self, state: State, batch: Batch, key: Array) -> tuple[State, dict[str, Array]]:
        """One Adam step of the actor on the critics as they evaluate, one of the temperature."""
        alpha = jnp.exp(state.log_alpha)
        warm = state.updates // self.updates_per_call > self.hyper.renorm_after

        def loss(actor: mlp.Network) -> tuple[Array, Any]:
            outputs, trained = batch_renorm.train(actor, batch.observation, warm)
            action, log_prob = gaussian.sample_from(outputs, key)
            value = critic_heads.min_q(self.values(state.critic, batch.observation, action))
            return (alpha * log_prob - value).mean(), (log_prob.mean(), trained)

        (value, (log_prob, trained)), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        adam = self._adam(self.hyper.actor_learning_rate)
        actor, opt_state = mlp.apply_gradient(adam, state.actor, gradient, state.actor_opt_state)
        actor = batch_renorm.with_statistics(self._unit_length(actor), trained)
        state = state._replace(actor=actor, actor_opt_state=opt_state)
        losses = {"actor_loss": value, "alpha": alpha, "entropy": -log_prob}
        return self.fit_temperature(state, log_prob), losses

    def _unit_length(self, network: mlp.Network) -> mlp.Network:
        if not self.hyper.weight_norm:
            return network
        return batch_renorm.unit_length(network)

    def _adam(self, rate: float) -> optax.GradientTransformation:
        return optax.adam(rate, b1=self.hyper.adam_momentum)

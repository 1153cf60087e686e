"""SAC with a learned temperature (Haarnoja et al. 2018b), one member. Reference: rlkit, SB3 sac.py.

    y = r + discount * (min_i target_critic_i(s', a') - alpha * log pi(a'|s')),  a' ~ pi(s')
    move every critic towards y
    move the actor up min_i critic_i(s, a) - alpha * log pi(a|s),  a ~ pi(s), on the moved critics
    move alpha towards the target entropy; move the critics' targets a little towards them

alpha is everywhere the one from before its own step, and actions stay in [-1, 1], so the target
entropy refers to that box.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter import nets
from pacesetter.algorithm import NO_MASK, Array, Batch, Spec, Update
from pacesetter.config import STRICT, LearningRate, OffPolicy, Switch, Tau, Warmup, Width
from pacesetter.policy import Actors, Floats, Layers, clip, forward

LOG_STD_RANGE = (-20.0, 2.0)


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(OffPolicy):
    """Defaults as in the paper's second version; warm-up is uniform, as in Spinning Up."""

    warmup: Warmup = Field(10_000, ge=0, description="first steps of all members, uniform actions")
    hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of hidden layers"
    )
    actor_learning_rate: LearningRate = Field(3e-4, gt=0, description="Adam step of the actor")
    critic_learning_rate: LearningRate = Field(3e-4, gt=0, description="Adam step of the critics")
    alpha_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam step of the log temperature"
    )
    initial_alpha: float = Field(1.0, gt=0, description="temperature at the start")
    target_entropy: float | None = Field(None, description="nats; none is minus the action size")
    tau: Tau = Field(0.005, gt=0, le=1, description="share of the network in a target update")
    critics: int = Field(2, ge=1, description="critics whose minimum is the target")
    critic_layer_norm: Switch = Field(False, description="layer norm before each critic ReLU")
    actor_layer_norm: Switch = Field(False, description="layer norm before each actor ReLU")


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: nets.Network
    critic: nets.Network
    target_critic: nets.Network
    log_alpha: Array
    actor_optimizer: Any
    critic_optimizer: Any
    alpha_optimizer: Any
    updates: Array


@dataclass(frozen=True)
class SAC:
    """The learner of one member."""

    spec: Spec
    hyper: Hyper
    cycle: int = 1

    def mask(self, rng: np.random.Generator) -> Floats:
        return NO_MASK

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        observation, action = self.spec
        hyper = self.hyper
        actor = nets.init(
            actor_key, observation, hyper.hidden, 2 * action, layer_norm=hyper.actor_layer_norm
        )
        critic = jax.vmap(self._new_critic)(jax.random.split(critic_key, hyper.critics))
        log_alpha = jnp.log(jnp.asarray(hyper.initial_alpha, jnp.float32))
        return State(
            actor=actor,
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),
            log_alpha=log_alpha,
            actor_optimizer=optax.adam(hyper.actor_learning_rate).init(actor),
            critic_optimizer=optax.adam(hyper.critic_learning_rate).init(critic),
            alpha_optimizer=optax.adam(hyper.alpha_learning_rate).init(log_alpha),
            updates=jnp.zeros((), jnp.int32),
        )

    def acting(self, state: State) -> nets.Network:
        return state.actor

    def begin(self, acting: Layers, rng: np.random.Generator) -> tuple[()]:
        return ()

    def act(
        self, acting: Layers, memory: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        mean, log_std = np.split(forward(acting, observation), 2)
        noise = rng.standard_normal(len(mean), np.float32)
        return np.tanh(mean + np.exp(clip(log_std, *LOG_STD_RANGE)) * noise), memory

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        target_key, actor_key = jax.random.split(key)
        minibatch = jax.tree.map(lambda x: x[0], batch)
        y = self.target(state, minibatch, target_key)
        state, critic_loss, error = self.fit_critic(state, minibatch, y, minibatch.weight)
        state, losses = self.fit_actor(state, minibatch, actor_key)
        return Update(state, {"critic_loss": critic_loss, **losses}, error[None])

    def ledger(self, updates: int, actions: int) -> dict[str, int]:
        return {}

    def policy(self, state: State) -> Actors:
        """The deterministic action is the tanh of the mean."""
        size = self.spec.action_size
        *hidden, last = state.actor
        mean = {name: value[..., :size] for name, value in last.items()}
        one = jax.tree.map(lambda x: x[None], (*hidden, mean))
        return Actors(one, activation="relu", output="tanh")

    # The pieces that `update` composes.

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Soft target y (B,)."""
        action, log_prob = sample(state.actor, batch.next_observation, key)
        values = nets.critics(state.target_critic, batch.next_observation, action).min(axis=0)
        soft = values - jnp.exp(state.log_alpha) * log_prob
        return jax.lax.stop_gradient(batch.reward + batch.discount * soft)

    def fit_critic(
        self, state: State, batch: Batch, y: Array, weight: Array
    ) -> tuple[State, Array, Array]:
        """One Adam step of all critics, one soft step of their targets; loss and |error| (B,)."""

        def loss(critic: nets.Network) -> tuple[Array, Array]:
            error = nets.critics(critic, batch.observation, batch.action) - y
            return (weight * error**2).mean(axis=1).sum(), jnp.abs(error).max(axis=0)

        (value, error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        adam = optax.adam(self.hyper.critic_learning_rate)
        critic, optimizer = nets.descend(adam, state.critic, gradient, state.critic_optimizer)
        state = state._replace(
            critic=critic,
            critic_optimizer=optimizer,
            target_critic=optax.incremental_update(critic, state.target_critic, self.hyper.tau),
            updates=state.updates + 1,
        )
        return state, value, error

    def fit_actor(self, state: State, batch: Batch, key: Array) -> tuple[State, dict[str, Array]]:
        """One Adam step of the actor on the given critics, and one of the temperature."""
        alpha = jnp.exp(state.log_alpha)

        def loss(actor: nets.Network) -> tuple[Array, Array]:
            action, log_prob = sample(actor, batch.observation, key)
            values = nets.critics(state.critic, batch.observation, action).min(axis=0)
            return (alpha * log_prob - values).mean(), log_prob.mean()

        (value, log_prob), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        adam = optax.adam(self.hyper.actor_learning_rate)
        actor, optimizer = nets.descend(adam, state.actor, gradient, state.actor_optimizer)
        wanted = self.hyper.target_entropy
        excess = -log_prob - (-self.spec.action_size if wanted is None else wanted)
        # d/dlog_alpha of log_alpha * excess entropy: too little entropy raises the temperature.
        adam = optax.adam(self.hyper.alpha_learning_rate)
        log_alpha, alpha_optimizer = nets.descend(
            adam, state.log_alpha, excess, state.alpha_optimizer
        )
        state = state._replace(
            actor=actor,
            actor_optimizer=optimizer,
            log_alpha=log_alpha,
            alpha_optimizer=alpha_optimizer,
        )
        return state, {"actor_loss": value, "alpha": alpha, "entropy": -log_prob}

    def _new_critic(self, key: Array) -> nets.Network:
        inputs = self.spec.observation_size + self.spec.action_size
        return nets.init(key, inputs, self.hyper.hidden, 1, layer_norm=self.hyper.critic_layer_norm)


build = SAC


def sample(actor: nets.Network, observation: Array, key: Array) -> tuple[Array, Array]:
    """An action (..., A) of the squashed Gaussian and its log-probability (...) in [-1, 1]."""
    mean, log_std = jnp.split(nets.apply(actor, observation), 2, axis=-1)
    log_std = jnp.clip(log_std, *LOG_STD_RANGE)
    noise = jax.random.normal(key, mean.shape)
    before = mean + jnp.exp(log_std) * noise
    return jnp.tanh(before), log_probability(before, noise, log_std)


def log_probability(before: Array, noise: Array, log_std: Array) -> Array:
    """log pi of tanh(before), before = mean + std * noise; stable where tanh saturates."""
    gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    squash = 2 * (jnp.log(2.0) - before - jax.nn.softplus(-2 * before))
    return (gaussian - squash).sum(axis=-1)

"""SAC with a learned temperature (Haarnoja et al. 2018b), one member. Reference: rlkit, SB3 sac.py.

    y = r + discount * (min_i target_critic_i(s', a') - alpha * log pi(a'|s')),  a' ~ pi(s')
    move every critic towards y
    move the actor up min_i critic_i(s, a) - alpha * log pi(a|s),  a ~ pi(s), on the moved critics
    move alpha towards the target entropy; move the critics' targets a little towards them

alpha is everywhere the one from before its own step, and actions stay in [-1, 1], so the target
entropy refers to that box.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import NO_MASK, Array, Batch, Spec, Update
from pacesetter.networks import critic_heads, mlp
from pacesetter.policy import Actors, Floats, Layers, clip, forward
from pacesetter.settings import STRICT, LearningRate, OffPolicy, Switch, Tau, Warmup, Width

LOG_STD_RANGE = (-20.0, 2.0)


def _policy(kind: str) -> str:
    if kind != "policy":
        raise ValueError("is fixed: a stochastic policy explores by itself; allowed: policy")
    return kind


Exploration = Annotated[str, AfterValidator(_policy)]


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
    critics: int = Field(2, ge=1, le=100, description="critics whose minimum is the target")
    critic_layer_norm: Switch = Field(False, description="layer norm before each critic ReLU")
    actor_layer_norm: Switch = Field(False, description="layer norm before each actor ReLU")
    quantiles: critic_heads.Quantiles = Field(
        0, description="quantiles that a critic learns, 25 is usual; 0 is the mean alone"
    )
    exploration: Exploration = Field(
        "policy", description="fixed: the stochastic policy explores by itself"
    )


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: mlp.Network
    critic: mlp.Network
    target_critic: mlp.Network
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

    @cached_property
    def head(self) -> critic_heads.Head:
        """What the critics' outputs mean."""
        return critic_heads.choose(self.hyper.quantiles, self.hyper.replay)

    def mask(self, rng: np.random.Generator) -> Floats:
        return NO_MASK

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
            actor_optimizer=optax.adam(hyper.actor_learning_rate).init(actor),
            critic_optimizer=optax.adam(hyper.critic_learning_rate).init(critic),
            alpha_optimizer=optax.adam(hyper.alpha_learning_rate).init(log_alpha),
            updates=jnp.zeros((), jnp.int32),
        )

    def acting(self, state: State) -> mlp.Network:
        return state.actor

    def begin(self, acting: Layers, rng: np.random.Generator) -> tuple[()]:
        return ()

    def act(
        self, acting: Layers, memory: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        return explore(acting, observation, rng), memory

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        target_key, actor_key = jax.random.split(key)
        minibatch = jax.tree.map(lambda x: x[0], batch)
        y = self.target(state, minibatch, target_key)
        state, critic_loss, error = self.fit_critic(state, minibatch, y, minibatch.weight)
        state, losses = self.fit_actor(state, minibatch, actor_key)
        return Update(state, {"critic_loss": critic_loss, **losses}, error[None])

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        return {}

    def policy(self, state: State) -> Actors:
        return mean_policy(state.actor, self.spec.action_size)

    # The pieces that `update` composes.

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Soft target y (B,), of quantiles (B, M)."""
        action, bonus = self.next_action(state, batch.next_observation, key)
        said = mlp.each(mlp.outputs, state.target_critic, batch.next_observation, action)
        following = self.head.least(said).T + bonus  # rows last, for quantiles too
        return jax.lax.stop_gradient(batch.reward + batch.discount * following).T

    def next_action(self, state: State, observation: Array, key: Array) -> tuple[Array, Array]:
        """The action (B, A) that a target asks about, and its entropy's worth (B,)."""
        action, log_prob = sample(state.actor, observation, key)
        return action, -jnp.exp(state.log_alpha) * log_prob

    def values(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B)."""
        return self.head.value(mlp.each(mlp.outputs, critic, observation, action))

    def fit_critic(
        self, state: State, batch: Batch, y: Array, weight: Array
    ) -> tuple[State, Array, Array]:
        """One Adam step of all critics, one soft step of their targets; loss and |error| (B,)."""

        def loss(critic: mlp.Network) -> tuple[Array, Array]:
            said = mlp.each(mlp.outputs, critic, batch.observation, batch.action)
            losses, error = self.head.loss(said, y)
            return (weight * losses).mean(axis=1).sum(), error.max(axis=0)

        (value, error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        adam = optax.adam(self.hyper.critic_learning_rate)
        critic, optimizer = mlp.descend(adam, state.critic, gradient, state.critic_optimizer)
        state = state._replace(
            critic=critic,
            critic_optimizer=optimizer,
            target_critic=optax.incremental_update(critic, state.target_critic, self.hyper.tau),
            updates=state.updates + 1,
        )
        return state, value, error

    def fit_actor(
        self, state: State, batch: Batch, key: Array, weight: Array | float = 1.0
    ) -> tuple[State, dict[str, Array]]:
        """One Adam step of the actor on the given critics, and one of the temperature."""
        alpha = jnp.exp(state.log_alpha)

        def loss(actor: mlp.Network) -> tuple[Array, Array]:
            action, log_prob = sample(actor, batch.observation, key)
            values = self.values(state.critic, batch.observation, action).min(axis=0)
            return (weight * (alpha * log_prob - values)).mean(), (weight * log_prob).mean()

        (value, log_prob), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        adam = optax.adam(self.hyper.actor_learning_rate)
        actor, optimizer = mlp.descend(adam, state.actor, gradient, state.actor_optimizer)
        state = state._replace(actor=actor, actor_optimizer=optimizer)
        losses = {"actor_loss": value, "alpha": alpha, "entropy": -log_prob}
        return fit_temperature(self, state, log_prob, jnp.mean(weight)), losses

    def _new_critic(self, key: Array) -> mlp.Network:
        inputs = self.spec.observation_size + self.spec.action_size
        return mlp.init(
            key,
            inputs,
            self.hyper.hidden,
            self.head.outputs,
            layer_norm=self.hyper.critic_layer_norm,
        )


build = SAC


def explore(actor: Layers, observation: Floats, rng: np.random.Generator) -> Floats:
    """An action (A,) drawn in NumPy."""
    said = forward(actor, observation)
    size = said.shape[-1] // 2  # np.split is slow for so few numbers
    mean, log_std = said[..., :size], said[..., size:]
    noise = rng.standard_normal(mean.shape, np.float32)
    return np.tanh(mean + np.exp(clip(log_std, *LOG_STD_RANGE)) * noise)


def mean_policy(actor: mlp.Network, size: int) -> Actors:
    """The deterministic action (size,) is the tanh of the mean."""
    *hidden, last = actor
    mean = {name: value[..., :size] for name, value in last.items()}
    one = jax.tree.map(lambda x: x[None], (*hidden, mean))
    return Actors(one, activation="relu", output="tanh")


def fit_temperature(learner: Any, state: Any, log_prob: Array, share: Array | float = 1.0) -> Any:
    """One Adam step of the temperature; too little entropy raises it. `share` is the mean weight
    of the rows behind the mean `log_prob`.
    """
    hyper = learner.hyper
    wanted = -learner.spec.action_size if hyper.target_entropy is None else hyper.target_entropy
    excess = -log_prob - share * wanted  # d/dlog_alpha of log_alpha * excess entropy
    adam = optax.adam(hyper.alpha_learning_rate)
    log_alpha, optimizer = mlp.descend(adam, state.log_alpha, excess, state.alpha_optimizer)
    return state._replace(log_alpha=log_alpha, alpha_optimizer=optimizer)


def sample(actor: mlp.Network, observation: Array, key: Array) -> tuple[Array, Array]:
    """An action (..., A) of the squashed Gaussian and its log-probability (...) in [-1, 1]."""
    return sample_from(mlp.apply(actor, observation), key)


def sample_from(said: Array, key: Array) -> tuple[Array, Array]:
    """The same from what an actor said (..., 2 A)."""
    mean, log_std = jnp.split(said, 2, axis=-1)
    log_std = jnp.clip(log_std, *LOG_STD_RANGE)
    noise = jax.random.normal(key, mean.shape)
    before = mean + jnp.exp(log_std) * noise
    return jnp.tanh(before), log_probability(before, noise, log_std)


def log_probability(before: Array, noise: Array, log_std: Array) -> Array:
    """log pi of tanh(before), before = mean + std * noise; stable where tanh saturates."""
    gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    far = -2 * jnp.abs(before)
    # With softplus, whose log1p is slow, an action takes three times as long and is no closer.
    squash = 2 * jnp.log(2.0) + far - 2 * jnp.log(1 + jnp.exp(far))
    return (gaussian - squash).sum(axis=-1)

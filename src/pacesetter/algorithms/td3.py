"""TD3 (Fujimoto et al. 2018), one member. Reference: sfujim/TD3, TD3.py at 34770cc.

for each of `policy_delay` minibatches:
    y = r + discount * min_i target_critic_i(s', target_actor(s') + clipped noise)
    move every critic towards y
move the actor up critic 1 on the last minibatch
move all targets a little towards their networks
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import NO_MASK, Array, Batch, Spec, Update
from pacesetter.networks import critic_heads, mlp
from pacesetter.networks.exploration import ADAPT_EVERY, KINDS, Kind, adapt_sigma, first_sigma
from pacesetter.policy import Actors, Floats
from pacesetter.settings import STRICT, LearningRate, OffPolicy, Switch, Tau, Tune, Width

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
    critics: int = Field(2, ge=1, le=100, description="critics whose minimum is the target")
    policy_delay: Annotated[int, Tune(1, 4)] = Field(
        2, ge=1, le=1_000, description="critic updates an actor update"
    )
    target_noise: Annotated[float, Tune(0.1, 0.4)] = Field(
        0.2, ge=0, description="deviation of the target action's noise"
    )
    target_noise_clip: float = Field(0.5, ge=0, description="bound of the target action's noise")
    critic_layer_norm: Switch = Field(False, description="layer norm before each critic ReLU")
    actor_layer_norm: Switch = Field(False, description="layer norm before each actor ReLU")
    quantiles: critic_heads.Quantiles = Field(
        0, description="quantiles that a critic learns, 25 is usual; 0 is the mean alone"
    )
    exploration: Kind = Field("gaussian", description="noise on actions, or on the actor's weights")
    exploration_noise: Annotated[float, Tune(0.05, 0.4, log=True)] = Field(
        0.1, ge=0, description="deviation of that noise, for parameter of the actions it causes"
    )


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: mlp.Network
    critic: mlp.Network
    target_actor: mlp.Network
    target_critic: mlp.Network
    actor_optimizer: Any
    critic_optimizer: Any
    updates: Array
    sigma: Array | None = None  # deviation of parameter noise


@dataclass(frozen=True)
class TD3:
    """The learner of one member; what follows `hyper` is for DDPG and STEVE to set."""

    spec: Spec
    hyper: Hyper
    action_layer: int = 0
    critic_decay: float = 0.0
    output_bound: float | None = None
    climbed: tuple[int, ...] = (0,)

    @cached_property
    def head(self) -> critic_heads.Head:
        """What the critics' outputs mean."""
        return critic_heads.choose(self.hyper.quantiles, self.hyper.replay)

    @property
    def cycle(self) -> int:
        return self.hyper.policy_delay

    def mask(self, rng: np.random.Generator) -> Floats:
        return NO_MASK

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = self._new_actor(actor_key)
        critic = jax.vmap(self._new_critic)(jax.random.split(critic_key, self.hyper.critics))
        noisy = self.hyper.exploration == "parameter"
        return State(
            actor=actor,
            critic=critic,
            target_actor=jax.tree.map(jnp.copy, actor),
            target_critic=jax.tree.map(jnp.copy, critic),
            actor_optimizer=self._actor_adam.init(actor),
            critic_optimizer=self._critic_adam.init(critic),
            updates=jnp.zeros((), jnp.int32),
            sigma=first_sigma(self.hyper.exploration_noise) if noisy else None,
        )

    def acting(self, state: State) -> Any:
        return state.actor if state.sigma is None else (state.actor, state.sigma)

    def begin(self, acting: Any, rng: np.random.Generator) -> Any:
        kind = KINDS[self.hyper.exploration]
        return kind.begin(acting, self.spec.action_size, rng)

    def act(
        self, acting: Any, memory: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        kind = KINDS[self.hyper.exploration]
        return kind.act(acting, memory, observation, self.hyper.exploration_noise, rng)

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        def critic_step(state: State, inputs: tuple[Batch, Array]) -> tuple[State, Any]:
            minibatch, step_key = inputs
            y = self.target(state, minibatch, step_key)
            state, loss, error = self.fit_critic(state, minibatch, y, minibatch.weight)
            return state, (loss, error)

        keys = jax.random.split(key, self.cycle + 1)
        state, (critic_losses, error) = jax.lax.scan(
            critic_step, state, (batch, keys[:-1]), unroll=min(self.cycle, UNROLLED)
        )
        last = jax.tree.map(lambda x: x[-1], batch)
        state, actor_loss = self.fit_actor(state, last)
        losses = {"critic_loss": critic_losses.mean(), "actor_loss": actor_loss}
        if state.sigma is not None:
            state = self.adapt(state, last, keys[-1])
            losses["sigma"] = state.sigma
        return Update(state, losses, error)

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        return {}

    def policy(self, state: State) -> Actors:
        one = jax.tree.map(lambda x: x[None], state.actor)
        return Actors(one, activation="relu", output="tanh")

    # The pieces that `update` composes.

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Clipped double-Q target y (B,), of quantiles (B, M); one noise draw a sample."""
        action = self.next_action(state, batch.next_observation, key)
        said = self.outputs(state.target_critic, batch.next_observation, action)
        following = self.head.least(said).T  # rows last, for quantiles too
        return jax.lax.stop_gradient(batch.reward + batch.discount * following).T

    def next_action(self, state: State, observation: Array, key: Array) -> Array:
        """The target actor's action (B, A) under clipped noise, which a target asks about."""
        limit = self.hyper.target_noise_clip
        clean = mlp.actor(state.target_actor, observation)
        noise = self.hyper.target_noise * jax.random.normal(key, clean.shape)
        return jnp.clip(clean + jnp.clip(noise, -limit, limit), -1, 1)

    def outputs(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """All that every critic says (critics, B, M)."""
        one = partial(mlp.outputs, action_layer=self.action_layer)
        return mlp.each(one, critic, observation, action)

    def values(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B)."""
        return self.head.value(self.outputs(critic, observation, action))

    def fit_critic(
        self, state: State, batch: Batch, y: Array, weight: Array
    ) -> tuple[State, Array, Array]:
        """One Adam step of all critics towards y; the loss and each row's largest |error| (B,)."""

        def loss(critic: mlp.Network) -> tuple[Array, Array]:
            losses, error = self.head.loss(self.outputs(critic, batch.observation, batch.action), y)
            return (weight * losses).mean(axis=1).sum(), error.max(axis=0)

        (value, error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        critic, optimizer = mlp.descend(
            self._critic_adam, state.critic, gradient, state.critic_optimizer
        )
        state = state._replace(critic=critic, critic_optimizer=optimizer, updates=state.updates + 1)
        return state, value, error

    def fit_actor(
        self, state: State, batch: Batch, weight: Array | float = 1.0
    ) -> tuple[State, Array]:
        """One Adam step of the actor up what it climbs, then one soft step of all targets."""

        def loss(actor: mlp.Network) -> Array:
            action = mlp.actor(actor, batch.observation)
            return -(weight * self.climbed_value(state.critic, batch.observation, action)).mean()

        value, gradient = jax.value_and_grad(loss)(state.actor)
        actor, optimizer = mlp.descend(
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

    def adapt(self, state: State, batch: Batch, key: Array) -> State:
        """Parameter noise adapted, if this cycle has passed a multiple of 50 updates."""
        goal = self.hyper.exploration_noise
        sigma = jax.lax.cond(
            state.updates % ADAPT_EVERY < self.cycle,
            lambda sigma: adapt_sigma(sigma, state.actor, goal, batch.observation, key),
            lambda sigma: sigma,
            state.sigma,
        )
        return state._replace(sigma=sigma)

    def climbed_value(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """The mean value (B,) by the critics that the actor climbs, in TD3 the first alone."""
        ones = [jax.tree.map(lambda x, i=i: x[i], critic) for i in self.climbed]
        said = [mlp.outputs(one, observation, action, self.action_layer) for one in ones]
        values = [self.head.value(each) for each in said]
        return sum(values[1:], values[0]) / len(values)

    def _new_actor(self, key: Array) -> mlp.Network:
        sizes = (self.spec.observation_size, self.hyper.hidden, self.spec.action_size)
        norm = self.hyper.actor_layer_norm
        return mlp.init(key, *sizes, layer_norm=norm, output_bound=self.output_bound)

    def _new_critic(self, key: Array) -> mlp.Network:
        return mlp.init(
            key,
            self.spec.observation_size,
            self.hyper.hidden,
            self.head.outputs,
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

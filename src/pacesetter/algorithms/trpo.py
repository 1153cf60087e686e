"""TRPO (Schulman et al. 2015) with generalised advantages (Schulman et al. 2016), one member.

delta = r + discount * V(s') - V(s);  A_t = sum over l of (gamma * lambda)^l delta_{t+l}
g = gradient of mean(ratio * A);  x = (F + damping)^-1 g by conjugate gradients
move the actor by c^j sqrt(2 max_kl / x'(F + damping)x) x, for the first of j = 0, 1, ... at
    which mean(ratio * A) is higher and KL(old || new) <= max_kl; if there is none, not at all
fit V to V + A
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import Array, Learner, Update
from pacesetter.batch import Batch, Spec
from pacesetter.networks import mlp
from pacesetter.networks.forward import forward
from pacesetter.networks.trust_region import (
    Distribution,
    Gaussian,
    distribution_of,
    fisher_product,
    kl,
    line_search,
    log_probability,
    natural_step,
)
from pacesetter.policy import Actors
from pacesetter.settings import STRICT, OnPolicy
from pacesetter.settings.values import SmallCount, SmallCountOr0, Width
from pacesetter.types import Floats


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(OnPolicy):
    """Tianshou's for MuJoCo, but for longer steps, less damping and minibatches of the critic."""

    hidden: tuple[Width, ...] = Field((64, 64), min_length=1, description="widths of hidden layers")
    initial_std: float = Field(0.6, gt=0, description="standard deviation of actions at the start")
    gae_lambda: float = Field(
        0.95, ge=0, le=1, description="lambda of generalised advantage estimation"
    )
    max_kl: float = Field(0.02, gt=0, description="largest mean KL divergence per update, in nats")
    damping: float = Field(0.01, ge=0, description="added to the Fisher matrix's diagonal")
    gradient_steps: int = Field(
        10, ge=1, le=1_000, description="conjugate gradient steps per update"
    )
    backtracks: int = Field(
        10, ge=1, le=1_000, description="step lengths that the line search tries at most"
    )
    backtrack_ratio: float = Field(
        0.8, gt=0, lt=1, description="factor from one tried step length to the next"
    )
    critic_learning_rate: float = Field(1e-3, gt=0, description="Adam learning rate of the critic")
    critic_epochs: SmallCountOr0 = Field(20, description="passes of the critic per rollout")
    critic_batch_size: SmallCount = Field(
        128, description="observations per minibatch of the critic"
    )


class State(NamedTuple):
    """One learner; the critic's output is in units of the deviation of all returns so far."""

    actor: Gaussian
    critic: mlp.Network
    critic_opt_state: Any
    returns: Array  # (3,): count, mean and squared deviations of the critic's targets so far
    updates: Array


@dataclass(frozen=True)
class TRPO(Learner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any

    def init(self, key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        (observation, action), hidden = self.spec, self.hyper.hidden
        critic = mlp.orthogonal(critic_key, observation, hidden, 1, output_gain=1.0)
        return State(
            actor=Gaussian(
                mlp.orthogonal(actor_key, observation, hidden, action, output_gain=0.01),
                jnp.full(action, np.log(self.hyper.initial_std), jnp.float32),
            ),
            critic=critic,
            critic_opt_state=self._adam.init(critic),
            returns=jnp.zeros(3),
            updates=jnp.zeros((), jnp.int32),
        )

    def policy_params(self, state: State) -> Gaussian:
        return state.actor

    def act(
        self, params: Any, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        mean = forward(params.network, observation, np.tanh)
        noise = rng.standard_normal(len(mean), np.float32)
        return mean + np.exp(params.log_std) * noise, noise_state

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        """One iteration on a rollout (T, E, ...)."""
        values = self.values(state, batch.observation)
        advantage = advantages(
            batch, values, self.values(state, batch.next_observation), self.hyper.gae_lambda
        )
        flat: Callable[[Array], Array] = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
        observation, targets = flat(batch.observation), flat(values + advantage)
        actor, losses = self.fit_actor(
            state.actor, observation, flat(batch.action), standardize(flat(advantage))
        )
        state, critic_loss = self.fit_critic(state, observation, targets, key)
        state = state._replace(actor=actor, updates=state.updates + 1)
        return Update(state, {"critic_loss": critic_loss, **losses}, jnp.abs(advantage))

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        hyper = self.hyper
        rows = hyper.parallel_envs * hyper.rollout_length
        minibatches = rows // min(hyper.critic_batch_size, rows)
        return {"critic_updates": updates * hyper.critic_epochs * minibatches}

    def policy(self, state: State) -> Actors:
        """The deterministic action is the mean."""
        one = jax.tree.map(lambda x: x[None], state.actor.network)
        return Actors(one, activation="tanh", output="clip")

    # The pieces that `update` composes.

    def values(self, state: State, observation: Array) -> Array:
        """V (...) of observations (..., O), in units of reward."""
        scaled = mlp.apply(state.critic, observation, jnp.tanh)[..., 0]
        return scaled * standard_deviation(state.returns)

    def fit_actor(
        self, actor: Gaussian, observation: Array, action: Array, advantage: Array
    ) -> tuple[Gaussian, dict[str, Array]]:
        """One natural gradient step within the trust region, from a batch (B, ...)."""
        hyper = self.hyper
        parameters, unravel = ravel_pytree(actor)

        def distribution(parameters: Array) -> Distribution:
            return distribution_of(unravel(parameters), observation)

        old = distribution(parameters)
        old_log_prob = log_probability(old, action)

        def surrogate(parameters: Array) -> Array:
            log_prob = log_probability(distribution(parameters), action)
            return (jnp.exp(log_prob - old_log_prob) * advantage).mean()

        before, gradient = jax.value_and_grad(surrogate)(parameters)
        fisher = fisher_product(distribution, parameters)
        full = natural_step(fisher, gradient, hyper.damping, hyper.max_kl, hyper.gradient_steps)

        def judge(candidate: Array) -> tuple[Array, Array]:
            divergence = kl(old, distribution(candidate))
            gain = surrogate(candidate) - before
            return (gain > 0) & (divergence <= hyper.max_kl), jnp.stack([divergence, gain])

        moved, accepted, (divergence, gain) = line_search(
            judge, parameters, full, hyper.backtrack_ratio, hyper.backtracks
        )
        losses = {
            "kl": divergence,
            "surrogate": gain,
            "accepted": accepted.astype(jnp.float32),
            "std": jnp.exp(actor.log_std).mean(),
        }
        return unravel(moved), losses

    def fit_critic(
        self, state: State, observation: Array, targets: Array, key: Array
    ) -> tuple[State, Array]:
        """Adam on minibatches (B,) of squared errors; the targets first join the scale."""
        size = min(self.hyper.critic_batch_size, len(targets))
        returns = add_statistics(state.returns, targets)
        scaled = targets / standard_deviation(returns)

        def loss(critic: mlp.Network, rows: Array) -> Array:
            values = mlp.apply(critic, observation[rows], jnp.tanh)[..., 0]
            return ((values - scaled[rows]) ** 2).mean()

        def step(carry: Any, rows: Array) -> tuple[Any, Array]:
            value, gradient = jax.value_and_grad(loss)(carry[0], rows)
            return mlp.apply_gradient(self._adam, carry[0], gradient, carry[1]), value

        def epoch(carry: Any, key: Array) -> tuple[Any, Array]:
            order = jax.random.permutation(key, len(targets))
            whole = len(targets) // size * size  # the few rows left over differ at every pass
            return jax.lax.scan(step, carry, order[:whole].reshape(-1, size))

        carry = (state.critic, state.critic_opt_state)
        (critic, optimizer), _ = jax.lax.scan(
            epoch, carry, jax.random.split(key, self.hyper.critic_epochs)
        )
        state = state._replace(critic=critic, critic_opt_state=optimizer, returns=returns)
        return state, loss(critic, jnp.arange(len(targets)))

    @property
    def _adam(self) -> optax.GradientTransformation:
        return optax.adam(self.hyper.critic_learning_rate)


def advantages(batch: Batch, values: Array, next_values: Array, decay: float) -> Array:
    """Generalised advantages (T, E) of a rollout from the values of its ends (both (T, E)).

    The value of what follows counts wherever the task goes on: after a time limit, and where the
    rollout is cut; errors of one episode never reach another.
    """
    delta = batch.reward + batch.discount * next_values - values

    def step(next_advantage: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        error, share = inputs
        advantage = error + share * next_advantage
        return advantage, advantage

    share = decay * batch.discount * (1 - batch.last)
    return jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta, share), reverse=True)[1]


def standardize(x: Array) -> Array:
    """Mean 0 and standard deviation 1; equal numbers become 0."""
    return (x - x.mean()) / (x.std() + 1e-8)


def add_statistics(sums: Array, values: Array) -> Array:
    """Count, mean and squared deviations (3,) with more values (B,) (Chan et al. 1979)."""
    count, mean, squares = sums
    added, total = len(values), count + len(values)
    change = values.mean() - mean
    squares += values.var() * added + change**2 * count * added / total
    return jnp.stack([total, mean + change * added / total, squares])


def standard_deviation(sums: Array) -> Array:
    """Of what the sums have seen; 1 before anything was seen or if all of it was equal."""
    count, _, squares = sums
    variance = squares / jnp.maximum(count, 1)
    return jnp.where(variance > 1e-8, jnp.sqrt(jnp.maximum(variance, 1e-8)), 1.0)

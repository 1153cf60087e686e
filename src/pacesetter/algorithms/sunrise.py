"""SUNRISE (Lee et al. 2021): N learners in one state, over SAC. Reference: pokaxpoka/sunrise at
0d43f0d, OpenAIGym_SAC. Every transition is stored with a mask: which learners train on it.

    a'_i from each learner i;  deviation_i over the ensemble's target values of (s', a'_i)
    fit critics i to their own target, weighted by mask_i * (sigmoid(-T * deviation_i) + 1/2)
    fit actor i, weighted by mask_i
    act: every learner proposes; the one with the largest mean + ucb * deviation of the ensemble's
        values is taken
    evaluate: the mean of all learners' actions

The paper and its authors' code differ; `--reference` chooses, and `official` marks each place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import sac
from pacesetter.algorithms.contract import (
    Array,
    Learner,
    State,
    Update,
    each_minibatch,
    last_minibatch,
)
from pacesetter.batch import Batch, Spec
from pacesetter.networks import mlp
from pacesetter.networks.critic_heads import min_q
from pacesetter.networks.forward import clip, forward
from pacesetter.policy import Actors
from pacesetter.settings import STRICT, only
from pacesetter.settings.values import Count
from pacesetter.types import Floats

BINS = 5  # of the backups' weights, which lie in [.5, 1]
OFFICIAL_BLOCK = 1000  # env steps between blocks of updates in the authors' code


@settings(frozen=True, kw_only=True, config=STRICT)
class EnsembleHyper:
    """What the ensemble adds; without a base class, whose defaults would hide the learner's own.

    Defaults are the reference's, with `ucb` from the range that the paper searched.
    """

    ensemble: int = Field(
        5, ge=1, le=100, description="learners per member, which act in one env (N)"
    )
    mask_probability: float = Field(
        0.5, gt=0, le=1, description="chance that a learner trains on a transition (beta)"
    )
    backup_temperature: float = Field(
        20.0, ge=0, description="temperature T of the weighted Bellman backup; 0 weights all alike"
    )
    ucb: float = Field(
        1.0,
        ge=0,
        description="standard deviations added to a proposed action's mean value (lambda)",
    )
    reference: Literal["paper", "official"] = Field(
        "paper", description="formulas as published, or as in the authors' code"
    )
    update_every: Count | None = Field(
        None,
        ge=1,
        description="env steps of a member between blocks of updates; default 1, official 1000",
    )
    quantiles: Annotated[int, only(0)] = Field(0, description="fixed: critics learn the mean")

    @property
    def block(self) -> int:
        """Env steps of a member between blocks of updates."""
        return self.update_every or (OFFICIAL_BLOCK if self.reference == "official" else 1)


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(EnsembleHyper, sac.Hyper):
    """SAC's settings and the ensemble's."""


class Params(NamedTuple):
    """Networks for NumPy: kernels (N, ...), all else with an axis for rows."""

    actor: Any
    critic: Any  # () where no values are asked


@dataclass(frozen=True)
class Sunrise(Learner):
    """N learners whose states are stacked, as one learner of the trainer."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any
    base: Any  # the learner that the ensemble is made of, such as SAC

    @classmethod
    def build(cls, spec: Spec, hyper: Any) -> Self:
        return cls(spec, hyper, sac.SAC(spec, hyper))

    @property
    def official(self) -> bool:
        """Whether the formulas are those of the authors' code."""
        return self.hyper.reference == "official"

    @property
    def updates_per_call(self) -> int:
        return self.base.updates_per_call

    def mask(self, rng: np.random.Generator) -> Floats:
        """Independent draws (N,); a transition that nobody took goes to one of them."""
        taken = rng.random(self.hyper.ensemble) < self.hyper.mask_probability
        if not taken.any():
            taken[rng.integers(len(taken))] = True
        return taken.astype(np.float32)

    def init(self, key: Array) -> State:
        return jax.vmap(self.base.init)(jax.random.split(key, self.hyper.ensemble))

    # One update.

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        """One call of every learner on the same transitions, each with its own keys."""
        keys = jax.random.split(key, (self.updates_per_call + 1, self.hyper.ensemble))
        state, (losses, td_error, *backup) = each_minibatch(
            self.critic_step, state, batch, keys[:-1]
        )
        last = last_minibatch(batch)
        fit_actor = jax.vmap(self.fit_actor, (0, None, 0, 0))
        state, actor_losses = fit_actor(state, last, keys[-1], self.share(last.mask))
        found = {name: loss.mean() for name, loss in actor_losses.items()}
        losses = {"critic_loss": losses.mean()} | found | backup_losses(*backup)
        return Update(state, losses, td_error)

    def critic_step(self, state: State, batch: Batch, keys: Array) -> tuple[State, Any]:
        """Move every learner's critics towards its own target, by the weights of its backups."""
        target_q, deviation = self.target(state, batch, keys)
        weight = backup_weight(deviation, self.hyper.backup_temperature)
        rows = batch.weight * weight * self.share(batch.mask)
        fit_critic = jax.vmap(self.base.fit_critic, (0, None, 0, 0))
        state, loss, td_error = fit_critic(state, batch, target_q, rows)
        learned = jnp.where(batch.mask.T > 0, td_error, 0)  # by those that train on the row
        return state, (loss.mean(), learned.max(axis=0), deviation, weight)

    def target(self, state: State, batch: Batch, keys: Array) -> tuple[Array, Array]:
        """Each learner's target (N, B); the next values' deviation (N, B), or one for all (B,)."""
        observation = batch.next_observation
        action, bonus = jax.vmap(self.next_action, (0, None, 0))(state, observation, keys)
        if self.official:  # every learner is asked about its own action only
            own = jax.vmap(self.base.values, (0, None, 0))(state.target_critic, observation, action)
            values = own
        else:
            own, values = self.values_of_all(state.target_critic, observation, action)
        target_q = batch.reward + batch.discount * (min_q(own, axis=1) + bonus)
        deviation = self.estimates(values).std(axis=0)
        return jax.lax.stop_gradient(target_q), jax.lax.stop_gradient(deviation)

    def values_of_all(self, critic: Any, observation: Array, action: Array) -> tuple[Array, Array]:
        """Values of each one's own action (N, critics, B), and of all by all (N, critics, N, B)."""
        values = [mlp.each(self.base.values, critic, observation, one) for one in action]
        own = jnp.stack([value[i] for i, value in enumerate(values)])
        return own, jnp.stack(values, axis=2)

    def estimates(self, values: Any) -> Any:
        """What mean and deviation are taken of: (N, critics, ...) to one estimate per learner, or
        per critic in the authors' code. NumPy and JAX arrays alike.
        """
        if self.official:
            return values.reshape(-1, *values.shape[2:])
        return min_q(values, axis=1)

    def share(self, mask: Array) -> Array:
        """Each learner's weight of transitions (N, B): a mean over B becomes one over its own."""
        rows = mask.sum(axis=0) + (1 if self.official else 0)
        return mask.T * (len(mask) / jnp.maximum(rows, 1))[:, None]

    # What is asked of the base.

    def next_action(self, state: State, observation: Array, key: Array) -> tuple[Array, Array]:
        """One learner's target action (B, A) and its entropy bonus (B,)."""
        return self.base.next_action(state, observation, key)

    def fit_actor(
        self, state: State, batch: Batch, key: Array, weight: Array
    ) -> tuple[State, dict[str, Array]]:
        """One learner's actor update."""
        return self.base.fit_actor(state, batch, key, weight)

    def blinded(self, state: State, seen: Array) -> State:
        return self.base.blinded(state, seen)

    # How it acts.

    @property
    def follows_one(self) -> bool:
        """Whether one learner, drawn per episode, acts alone, as in bootstrapped DQN."""
        return self.official and self.hyper.ucb == 0

    def policy_params(self, state: State) -> Params:
        critic = () if self.follows_one else _for_rows(state.critic)
        return Params(_for_rows(state.actor), critic)

    def start_episode(self, params: Params, rng: np.random.Generator) -> tuple[Any, Any]:
        noise = self.base.start_episode(self._of_base(params), rng)
        return noise, np.array(rng.integers(self.hyper.ensemble)) if self.follows_one else ()

    def act(
        self, params: Params, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        noise, follows = noise_state
        actions, noise = self.base.act(self._of_base(params), noise, observation[None], rng)
        actions = clip(actions[:, 0])
        if self.follows_one:
            chosen = int(follows)
        else:
            chosen = int(np.argmax(self.upper_bounds(params.critic, observation, actions)))
        return actions[chosen], (noise, follows)

    def upper_bounds(self, critic: Any, observation: Floats, actions: Floats) -> Floats:
        """Upper confidence bound (N,) of each action's value, on the online critics."""
        repeated = np.broadcast_to(observation, (len(actions), len(observation)))
        values = forward(critic, np.concatenate([repeated, actions], axis=1))[..., 0]
        estimates = self.estimates(values)
        return estimates.mean(axis=0) + self.hyper.ucb * estimates.std(axis=0)

    def policy(self, state: State) -> Actors:
        """All learners' actors, whose actions the policy averages."""
        states = [jax.tree.map(lambda x, i=i: x[i], state) for i in range(self.hyper.ensemble)]
        actors = [self.base.policy(state) for state in states]
        layers = jax.tree.map(lambda *x: jnp.concatenate(x), *[each.layers for each in actors])
        return actors[0]._replace(layers=layers)

    def _of_base(self, params: Params) -> Any:
        """The actors as the base's own `act` takes them."""
        return params.actor

    # What the trainer may ask besides.

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        size = self.hyper.ensemble
        passes = 0 if self.follows_one else size + size * size * self.hyper.critics
        return {"ensemble_updates": size * updates, "ucb_passes": passes * actions}

    def copy_weights(self, own: State, parent: State) -> State:
        return self.base.copy_weights(own, parent)

    def copy_actor(self, own: State, parent: State) -> State:
        return self.base.copy_actor(own, parent)


def backup_weight(deviation: Array, temperature: float) -> Array:
    """In (.5, 1]: 1 where the ensemble agrees (equation 3)."""
    return jax.nn.sigmoid(-temperature * deviation) + 0.5


def backup_losses(deviation: Array, weight: Array) -> dict[str, Array]:
    """How far the ensemble disagrees, and the share of backups by weight, in bins of a tenth."""
    found = {"value_deviation": deviation.mean(), "backup_weight": weight.mean()}
    bins = jnp.clip(jnp.floor((weight - 0.5) * 2 * BINS), 0, BINS - 1)
    names = [f"backup_weight_0.{5 + i}" for i in range(BINS)]
    return found | {name: (bins == i).mean() for i, name in enumerate(names)}


def _for_rows(network: Any) -> Any:
    """Biases and norms that add to (N, rows, outputs)."""
    return tuple(
        {name: x if name == "kernel" else x[..., None, :] for name, x in layer.items()}
        for layer in network
    )

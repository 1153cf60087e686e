"""SUNRISE (Lee et al. 2021): N learners in one state, over SAC. Reference: pokaxpoka/sunrise at
0d43f0d, OpenAIGym_SAC. Every row is stored with a mask: the learners that may train on it.

    a'_i from each learner i;  deviation_i over the ensemble's target values of (s', a'_i)
    fit critics i to their own target, rows weighed by mask_i * (sigmoid(-T * deviation_i) + 1/2)
    fit actor i, rows weighed by mask_i
    act: every learner proposes; the largest mean + ucb * deviation of the ensemble's values is done
    evaluate: the mean of all learners' actions

What the paper says and what its code does differ; `FORMS` holds both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import sac
from pacesetter.algorithms.contract import Array, Batch, Spec, State, Update
from pacesetter.algorithms.td3 import UNROLLED
from pacesetter.networks import mlp
from pacesetter.policy import Actors, Floats, clip, forward
from pacesetter.settings import STRICT, Count, only

BINS = 5  # of the backups' weights, which lie in [.5, 1]


@settings(frozen=True, kw_only=True, config=STRICT)
class Ensemble:
    """What the ensemble adds; without a base class, whose defaults would hide the learner's own.

    Defaults are the reference's, with `ucb` from the range that the paper searched.
    """

    ensemble: int = Field(5, ge=1, le=100, description="learners in one state (N)")
    mask_probability: float = Field(
        0.5, gt=0, le=1, description="chance that a learner trains on a row (beta)"
    )
    backup_temperature: float = Field(
        20.0, ge=0, description="how fast deviation takes weight off a backup (T); 0 is never"
    )
    ucb: float = Field(1.0, ge=0, description="deviations on top of an action's value (lambda)")
    reference: Literal["paper", "official"] = Field(
        "paper", description="formulas as published, or as the authors' code has them"
    )
    update_every: Count | None = Field(
        None, ge=1, description="own steps between blocks of updates; none is 1, official 1000"
    )
    quantiles: Annotated[int, only(0)] = Field(0, description="fixed: critics learn the mean")

    @property
    def block(self) -> int:
        return self.update_every or FORMS[self.reference].block


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(Ensemble, sac.Hyper):
    """SAC's settings and the ensemble's."""


class Base(NamedTuple):
    """What is asked of the learner that the ensemble is made of."""

    learner: Any  # with init, act, policy, values, fit_critic and cycle as in SAC and TD3
    next_action: Callable[[State, Array, Array], tuple[Array, Array]]  # and its bonus
    fit_actor: Callable[[State, Batch, Array, Array], tuple[State, dict[str, Array]]]


class Acting(NamedTuple):
    """Networks for NumPy: kernels (N, ...), all else with an axis for rows."""

    actor: Any
    critic: Any


# What an action of the ensemble is worth: values (N, critics, ...) to estimates (n, ...), whose
# mean and deviation count. NumPy and JAX arrays alike.


def member_estimates(values: Any) -> Any:
    """One a member: the minimum of its critics."""
    return values.min(axis=1)


def critic_estimates(values: Any) -> Any:
    """One a critic."""
    return values.reshape(-1, *values.shape[2:])


# Which actions the deviation is taken at; `ask` gives one member's values.

Ask = Callable[[Any, Array, Array], Array]


def at_each_action(ask: Ask, critic: Any, observation: Array, action: Array) -> tuple[Array, Array]:
    """Values of member i at its own action (N, critics, B); of all at i's (N, critics, N, B)."""
    everyone = jax.vmap(ask)
    values = [everyone(critic, *mlp.apart(len(action), (observation, one))) for one in action]
    own = jnp.stack([value[i] for i, value in enumerate(values)])
    return own, jnp.stack(values, axis=2)


def at_own_actions(ask: Ask, critic: Any, observation: Array, action: Array) -> tuple[Array, Array]:
    """Values of member i at its own action (N, critics, B), twice: nothing else is asked."""
    values = jax.vmap(ask, (0, None, 0))(critic, observation, action)
    return values, values


class Inference(NamedTuple):
    """How one of the proposed actions is chosen."""

    acting: Callable[[State], Acting]
    begin: Callable[[int, np.random.Generator], Any]  # (N, rng) -> memory of an episode
    choose: Callable[[Any, Callable[[], Floats]], int]  # (memory, upper bounds (N,)) -> which
    passes: Callable[[int, int], int]  # (N, critics) -> forward passes that the bounds take


BEST_BOUND = Inference(
    lambda state: Acting(_for_rows(state.actor), _for_rows(state.critic)),
    lambda size, rng: (),
    lambda memory, bounds: int(np.argmax(bounds())),
    lambda size, critics: size + size * size * critics,
)
RANDOM_MEMBER = Inference(  # for a whole episode, as in bootstrapped DQN
    lambda state: Acting(_for_rows(state.actor), ()),
    lambda size, rng: np.array(rng.integers(size)),
    lambda memory, bounds: int(memory),
    lambda size, critics: 0,
)


class Form(NamedTuple):
    """Where paper and code differ."""

    estimates: Callable[[Any], Any]
    asked: Callable[[Ask, Any, Array, Array], tuple[Array, Array]]
    surplus: int  # added to the number of rows that a masked loss is divided by
    block: int  # env steps between blocks of updates
    without_ucb: Inference


FORMS = {
    "paper": Form(member_estimates, at_each_action, 0, 1, BEST_BOUND),
    "official": Form(critic_estimates, at_own_actions, 1, 1000, RANDOM_MEMBER),
}


@dataclass(frozen=True)
class Sunrise:
    """N learners whose states are stacked, as one learner of the trainer."""

    spec: Spec
    hyper: Any
    base: Base
    form: Form
    inference: Inference

    @property
    def cycle(self) -> int:
        return self.base.learner.cycle

    def mask(self, rng: np.random.Generator) -> Floats:
        """Independent draws; a row that nobody took goes to one of them."""
        taken = rng.random(self.hyper.ensemble) < self.hyper.mask_probability
        if not taken.any():
            taken[rng.integers(len(taken))] = True
        return taken.astype(np.float32)

    def init(self, key: Array) -> State:
        return jax.vmap(self.base.learner.init)(jax.random.split(key, self.hyper.ensemble))

    def acting(self, state: State) -> Acting:
        return self.inference.acting(state)

    def begin(self, acting: Acting, rng: np.random.Generator) -> tuple[Any, Any]:
        noise = self.base.learner.begin(acting.actor, rng)
        return noise, self.inference.begin(self.hyper.ensemble, rng)

    def act(
        self, acting: Acting, memory: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        noise, episode = memory
        actions, noise = self.base.learner.act(acting.actor, noise, observation[None], rng)
        actions = clip(actions[:, 0])
        bounds = partial(self.bounds, acting.critic, observation, actions)
        chosen = self.inference.choose(episode, bounds)
        return actions[chosen], (noise, episode)

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        """One cycle of every learner on the same rows, each with its own keys."""
        fit_critic = jax.vmap(self.base.learner.fit_critic, (0, None, 0, 0))
        fit_actor = jax.vmap(self.base.fit_actor, (0, None, 0, 0))

        def critic_step(state: State, inputs: tuple[Batch, Array]) -> tuple[State, Any]:
            minibatch, keys = inputs
            y, deviation = self.target(state, minibatch, keys)
            weight = backup_weight(deviation, self.hyper.backup_temperature)
            rows = minibatch.weight * weight * self.share(minibatch.mask)
            state, loss, error = fit_critic(state, minibatch, y, rows)
            return state, (loss.mean(), error.max(axis=0), deviation, weight)

        keys = jax.random.split(key, (self.cycle + 1, self.hyper.ensemble))
        state, (losses, error, *backup) = jax.lax.scan(
            critic_step, state, (batch, keys[:-1]), unroll=min(self.cycle, UNROLLED)
        )
        last = jax.tree.map(lambda x: x[-1], batch)
        state, actor_losses = fit_actor(state, last, keys[-1], self.share(last.mask))
        found = {name: loss.mean() for name, loss in actor_losses.items()}
        return Update(state, {"critic_loss": losses.mean()} | found | report(*backup), error)

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        size = self.hyper.ensemble
        passes = self.inference.passes(size, self.hyper.critics)
        return {"ensemble_updates": size * updates, "ucb_passes": passes * actions}

    def policy(self, state: State) -> Actors:
        """All learners' actors, whose actions the policy averages."""
        states = [jax.tree.map(lambda x, i=i: x[i], state) for i in range(self.hyper.ensemble)]
        actors = [self.base.learner.policy(state) for state in states]
        layers = jax.tree.map(lambda *x: jnp.concatenate(x), *[each.layers for each in actors])
        return actors[0]._replace(layers=layers)

    # The pieces that `act` and `update` compose.

    def bounds(self, critic: Any, observation: Floats, actions: Floats) -> Floats:
        """Upper confidence bound (N,) of each action's value, on the online critics."""
        repeated = np.broadcast_to(observation, (len(actions), len(observation)))
        values = forward(critic, np.concatenate([repeated, actions], axis=1))[..., 0]
        estimates = self.form.estimates(values)
        return estimates.mean(axis=0) + self.hyper.ucb * estimates.std(axis=0)

    def target(self, state: State, batch: Batch, keys: Array) -> tuple[Array, Array]:
        """Each learner's y (N, B); the next values' deviation (N, B), or one for all (B,)."""
        ask, observation = self.base.learner.values, batch.next_observation
        action, bonus = jax.vmap(self.base.next_action, (0, None, 0))(state, observation, keys)
        own, values = self.form.asked(ask, state.target_critic, observation, action)
        y = batch.reward + batch.discount * (own.min(axis=1) + bonus)
        deviation = self.form.estimates(values).std(axis=0)
        return jax.lax.stop_gradient(y), jax.lax.stop_gradient(deviation)

    def share(self, mask: Array) -> Array:
        """Each learner's weight of rows (N, B), with which a mean over B is one over its own."""
        rows = mask.sum(axis=0) + self.form.surplus
        return mask.T * (len(mask) / jnp.maximum(rows, 1))[:, None]


def build(spec: Spec, hyper: Hyper) -> Sunrise:
    """The learner of one member, over SAC."""
    learner = sac.SAC(spec, hyper)
    return assemble(spec, hyper, Base(learner, learner.next_action, learner.fit_actor))


def assemble(spec: Spec, hyper: Any, base: Base) -> Sunrise:
    """An ensemble over any base, in the form that its settings ask for."""
    form = FORMS[hyper.reference]
    return Sunrise(spec, hyper, base, form, BEST_BOUND if hyper.ucb > 0 else form.without_ucb)


def backup_weight(deviation: Array, temperature: float) -> Array:
    """In (.5, 1]: 1 where the ensemble agrees (equation 3)."""
    return jax.nn.sigmoid(-temperature * deviation) + 0.5


def report(deviation: Array, weight: Array) -> dict[str, Array]:
    """How far the ensemble is apart, and the share of backups by weight, in bins of a tenth."""
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

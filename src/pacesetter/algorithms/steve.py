"""STEVE over DDPG (Buckman et al. 2018), one member. Reference: tensorflow/models, research/steve.

    T_0 = r + discount * Q'(s', pi'(s')),  the ordinary target
    T_i = the same after i more steps in a learned model, with learned rewards and ends
    y = sum_i w_i mean(T_i),  w_i ~ 1 / variance(T_i) over models x reward heads x critics
    everything else as in DDPG, critics and models each on rows of their own

STEVE replaces only the target: with horizon 0 and one critic it is DDPG, and over TD3, TD3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import ddpg, td3
from pacesetter.algorithms.contract import NO_MASK, Array, Batch, Spec, Update
from pacesetter.dynamics.model import Dynamics, Models
from pacesetter.networks import mlp
from pacesetter.networks.exploration import Kind
from pacesetter.policy import Actors, Floats
from pacesetter.settings import STRICT, Width

SMALLEST_VARIANCE = 1e-8  # as in the reference
MODELS = 2**16  # what is folded into a key for the models: far from what the base splits off


def has_rows(count: int, info: ValidationInfo) -> int:
    """Every model and critic member must get a row of each minibatch."""
    rows = info.data.get("batch_size", count)
    if count > rows:
        raise ValueError(f"is more than there are rows in a minibatch; allowed: up to {rows}")
    return count


def can_disagree(count: int, info: ValidationInfo) -> int:
    """A lone critic member never varies, so it would take all weight from the models."""
    if count == 1 and info.data.get("horizon", 0) > 0:
        raise ValueError("gives the models no weight; allowed: from 2 on, or --horizon 0")
    return has_rows(count, info)


@settings(frozen=True, kw_only=True, config=STRICT)
class Expansion:
    """What STEVE adds to its base, or fixes; sizes are below the published ones (steve-paper)."""

    horizon: int = Field(3, ge=0, le=20, description="longest imagined way; 0 is no model at all")
    critic_members: Annotated[int, AfterValidator(can_disagree)] = Field(
        4,
        ge=1,
        validate_default=True,
        description="critics that give the target its variance; each learns own rows",
    )
    models: Annotated[int, AfterValidator(has_rows)] = Field(
        4,
        ge=1,
        validate_default=True,
        description="models, and reward heads; each learns own rows",
    )
    model_hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of a model's hidden layers"
    )
    head_hidden: tuple[Width, ...] = Field(
        (64, 64), min_length=1, description="widths in the heads for reward and termination"
    )
    model_learning_rate: float = Field(1e-3, gt=0, description="Adam step of the models")
    model_decay: float = Field(0.0, ge=0, description="L2 added to the models' gradient")
    quantiles: Annotated[int, ddpg.only(0)] = Field(0, description="fixed: variances are of means")
    n_step: Annotated[int, ddpg.only(1)] = Field(1, description="fixed: models learn single steps")


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(Expansion, ddpg.Hyper):
    """DDPG's settings and the expansion's; exploration is the paper's."""

    exploration: Kind = Field("sparse", description="noise on actions, or on weights")
    exploration_noise: float = Field(1.0, ge=0, description="deviation of that noise")


class State(NamedTuple):
    """A TD3 learner's fields, critics (members x twins) on a leading axis, and the models."""

    actor: mlp.Network
    critic: mlp.Network
    target_actor: mlp.Network
    target_critic: mlp.Network
    models: Models
    actor_optimizer: Any
    critic_optimizer: Any
    models_optimizer: Any
    updates: Array
    sigma: Array | None = None


@dataclass(frozen=True)
class STEVE:
    """The learner of one member; `base` is a TD3, which asks of a state no more than its fields."""

    base: Any
    dynamics: Dynamics
    hyper: Any

    @property
    def cycle(self) -> int:
        return self.base.cycle

    def mask(self, rng: np.random.Generator) -> Floats:
        return NO_MASK

    def init(self, key: Array) -> State:
        learner = self.base.init(key)
        # Split off so that the base's own keys, and with them its weights, stay what they are.
        models = self.dynamics.init(jax.random.fold_in(key, MODELS))
        moments = self.dynamics.init_optimizer(models)
        return State(models=models, models_optimizer=moments, **learner._asdict())

    def acting(self, state: State) -> Any:
        return self.base.acting(state)

    def begin(self, acting: Any, rng: np.random.Generator) -> Any:
        return self.base.begin(acting, rng)

    def act(
        self, acting: Any, memory: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        return self.base.act(acting, memory, observation, rng)

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        def step(state: State, inputs: tuple[Batch, Array]) -> tuple[State, Any]:
            minibatch, step_key = inputs
            state, model_loss = self.fit_models(state, minibatch)
            y, weights = self.target(state, minibatch, step_key)
            own = minibatch.weight * self.routes(len(y))
            state, loss, error = self.base.fit_critic(state, minibatch, y, own)
            losses = {"critic_loss": loss, "model_loss": model_loss}
            return state, (losses | {"model_use": 1 - weights[0].mean()}, error)

        keys = jax.random.split(key, self.cycle + 1)
        unroll = min(self.cycle, td3.UNROLLED)
        state, (each, error) = jax.lax.scan(step, state, (batch, keys[:-1]), unroll=unroll)
        last = jax.tree.map(lambda x: x[-1], batch)
        state, actor_loss = self.base.fit_actor(state, last)
        losses = {name: value.mean() for name, value in each.items()} | {"actor_loss": actor_loss}
        if state.sigma is not None:
            state = self.base.adapt(state, last, keys[-1])
            losses["sigma"] = state.sigma
        return Update(state, losses, error)

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        """Steps of the models' optimiser, and imagined transitions."""
        rows = self.hyper.batch_size * self.hyper.models * self.hyper.horizon
        return {"model_updates": updates, "imagined_transitions": updates * rows}

    def policy(self, state: State) -> Actors:
        return self.base.policy(state)

    # The pieces that `update` composes.

    def target(self, state: State, batch: Batch, key: Array) -> tuple[Array, Array]:
        """The target y (B,) and the weights (H + 1, B) of the horizons in it."""
        return jax.lax.stop_gradient(combine(self.candidates(state, batch, key)))

    def candidates(self, state: State, batch: Batch, key: Array) -> list[Array]:
        """T_0 .. T_H, each (estimates, B): L of T_0, L critics x N heads x M models of the others.

        A rollout stays with its model and sums one head's rewards. Models share the noise of a
        step, so that it does not count as their variance; the ends of the first step are real.
        """
        paid, factor, observation = batch.reward, batch.discount, batch.next_observation
        action, value = self.ask(state, observation, key)
        found = [paid + factor * value]
        every = (observation, action)
        observation, action = (jnp.stack([x] * self.hyper.models) for x in every)
        for step in range(1, self.hyper.horizon + 1):
            following, _ = self.dynamics.predict(state.models, observation, action)
            transition = (state.models, observation, action, following)
            paid = paid + factor * self.dynamics.reward(*transition)
            factor = factor * self.hyper.gamma * (1 - self.dynamics.terminated(*transition))
            step_key, observation = jax.random.fold_in(key, step), following
            asked = jax.vmap(self.ask, (None, 0, None), (0, 1))
            action, value = asked(state, observation, step_key)
            found.append((paid + factor * value[:, None]).reshape(-1, len(batch.reward)))
        return found

    def ask(self, state: State, observation: Array, key: Array) -> tuple[Array, Array]:
        """The target action (B, A) and what it is worth to each critic member (L, B)."""
        action = self.base.next_action(state, observation, key)
        values = self.values(state.target_critic, observation, action)
        return action, values.reshape(-1, self.hyper.critics, len(observation)).min(axis=1)

    def values(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """Every critic's value (critics, B)."""
        return self.base.values(critic, observation, action)

    def routes(self, rows: int) -> Array:
        """1 where a critic learns from a row, (critics, B); a minibatch has them in any order."""
        members = jnp.arange(self.hyper.critic_members)
        own = jnp.arange(rows) % len(members) == members[:, None]
        return own.repeat(self.hyper.critics, axis=0).astype(jnp.float32)

    def fit_models(self, state: State, batch: Batch) -> tuple[State, Array]:
        """One Adam step of every model, each on every `models`-th row; their mean loss."""
        count = self.hyper.models
        models = self.dynamics.observe(state.models, batch)

        def deal(x: Array) -> Array:
            each = len(x) // count
            return x[: each * count].reshape(each, count, *x.shape[1:]).swapaxes(0, 1)

        models, moments, loss = self.dynamics.step(
            models, state.models_optimizer, jax.tree.map(deal, batch)
        )
        return state._replace(models=models, models_optimizer=moments), loss


def combine(candidates: Sequence[Array]) -> tuple[Array, Array]:
    """Targets (B,) and weights (H + 1, B) from the candidates (estimates, B) of each horizon."""
    mean = jnp.stack([each.mean(axis=0) for each in candidates])
    if len(mean) == 1:  # nothing to weigh, so that not even a last bit changes
        return mean[0], jnp.ones_like(mean)
    variance = jnp.stack([each.var(axis=0) for each in candidates])
    weight = 1 / (variance + SMALLEST_VARIANCE)
    weight = weight / weight.sum(axis=0)
    return (weight * mean).sum(axis=0), weight


def build(spec: Spec, hyper: Hyper) -> STEVE:
    """The learner of one member, over DDPG."""
    return over(spec, hyper, hyper.action_layer, hyper.critic_decay, hyper.output_bound)


def over(spec: Spec, hyper: Any, *more: Any) -> STEVE:
    """STEVE over a TD3 with as many critics as its members have together."""
    table = {field.name: getattr(hyper, field.name) for field in fields(td3.Hyper)}
    table["critics"] = hyper.critics * hyper.critic_members
    climbed = tuple(range(0, table["critics"], hyper.critics))
    base = td3.TD3(spec, td3.Hyper(**table), *more, climbed=climbed)
    dynamics = Dynamics(
        spec,
        hyper.models,
        hyper.model_hidden,
        hyper.head_hidden,
        learning_rate=hyper.model_learning_rate,
        decay=hyper.model_decay,
    )
    return STEVE(base, dynamics, hyper)

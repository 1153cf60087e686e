"""STEVE over DDPG (Buckman et al. 2018), one member. Reference: tensorflow/models, research/steve.

    T_0 = r + discount * Q'(s', pi'(s')),  the ordinary target
    T_i = the same after i more steps in a learned model, with learned rewards and ends
    target_q = sum_i w_i mean(T_i),  w_i ~ 1 / variance(T_i) over models x reward heads x critics
    everything else as in DDPG, critics and models each on rows of their own

STEVE replaces only the target: with horizon 0 and one critic it is DDPG, and over TD3, TD3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import ddpg, td3
from pacesetter.algorithms.contract import Array
from pacesetter.batch import Batch
from pacesetter.dynamics.model import Dynamics, Models
from pacesetter.networks import mlp
from pacesetter.networks.critic_heads import min_q
from pacesetter.networks.exploration import Kind
from pacesetter.settings import STRICT, only
from pacesetter.settings.values import Width

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
class ExpansionHyper:
    """What STEVE adds to its base, or fixes; sizes are below the published ones (steve-paper)."""

    horizon: int = Field(
        3, ge=0, le=20, description="rollout horizon H in the models; 0 uses no model"
    )
    critic_members: Annotated[int, AfterValidator(can_disagree)] = Field(
        4,
        ge=1,
        validate_default=True,
        description="critics whose disagreement weights the target; each learns from its own "
        "share of a minibatch",
    )
    models: Annotated[int, AfterValidator(has_rows)] = Field(
        4,
        ge=1,
        validate_default=True,
        description="learned models, and as many reward heads; each learns from its own share of a "
        "minibatch",
    )
    model_hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of a model's hidden layers"
    )
    head_hidden: tuple[Width, ...] = Field(
        (64, 64), min_length=1, description="widths in the heads for reward and termination"
    )
    model_learning_rate: float = Field(1e-3, gt=0, description="Adam learning rate of the models")
    model_decay: float = Field(0.0, ge=0, description="L2 decay added to the models' gradient")
    quantiles: Annotated[int, only(0)] = Field(0, description="fixed: variances are of means")
    n_step: Annotated[int, only(1)] = Field(1, description="fixed: models learn single steps")


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(ExpansionHyper, ddpg.Hyper):
    """DDPG's settings and the expansion's; exploration is the paper's."""

    exploration: Kind = Field("sparse", description="noise on actions, or on the actor's weights")
    exploration_noise: float = Field(1.0, ge=0, description="standard deviation of that noise")


class State(NamedTuple):
    """A TD3 learner's fields, critics (members x twins) on a leading axis, and the models."""

    actor: mlp.Network
    critic: mlp.Network
    target_actor: mlp.Network
    target_critic: mlp.Network
    models: Models
    actor_opt_state: Any
    critic_opt_state: Any
    models_opt_state: Any
    updates: Array
    exploration: Any


class Expansion(td3.TD3):
    """What STEVE changes in TD3 or DDPG: the models, the target, and whom the actor climbs."""

    @cached_property
    def dynamics(self) -> Dynamics:
        """The ensemble of models."""
        hyper = self.hyper
        return Dynamics(
            self.spec,
            hyper.models,
            hyper.model_hidden,
            hyper.head_hidden,
            learning_rate=hyper.model_learning_rate,
            decay=hyper.model_decay,
        )

    @property
    def critic_count(self) -> int:
        return self.hyper.critics * self.hyper.critic_members

    def init(self, key: Array) -> Any:
        learner = super().init(key)
        # Split off so that the base's own keys, and with them its weights, stay what they are.
        models = self.dynamics.init(jax.random.fold_in(key, MODELS))
        opt_state = self.dynamics.init_opt_state(models)
        return State(models=models, models_opt_state=opt_state, **learner._asdict())

    def critic_step(self, state: Any, batch: Batch, key: Array) -> tuple[Any, Any]:
        """Fit the models, then move every critic towards the expanded target on its own rows."""
        told: dict[str, Array] = {}
        if self.hyper.horizon:
            state, told["model_loss"] = self.fit_models(state, batch)
        target_q, weights = self.expanded_target(state, batch, key)
        own = batch.weight * self.routes(len(target_q))
        state, loss, td_error = self.fit_critic(state, batch, target_q, own)
        told |= {"critic_loss": loss, "model_use": 1 - weights[0].mean()}
        return state, (told, td_error)

    def actor_value(self, critic: mlp.Network, observation: Array, action: Array) -> Array:
        """The mean value (B,) by the first critic of every member."""
        firsts = range(0, self.critic_count, self.hyper.critics)
        ones = [jax.tree.map(lambda x, i=i: x[i], critic) for i in firsts]
        outputs = [self.critic_network(one, observation, action) for one in ones]
        values = [self.head.value(each) for each in outputs]
        return sum(values[1:], values[0]) / len(values)

    def ledger(self, states: Sequence[Any], updates: int, actions: int) -> dict[str, int]:
        """Steps of the models' optimiser, and imagined transitions."""
        rows = self.hyper.batch_size * self.hyper.models * self.hyper.horizon
        fits = updates if self.hyper.horizon else 0
        return {"model_updates": fits, "imagined_transitions": updates * rows}

    def copy_weights(self, own: Any, parent: Any) -> Any:
        return super().copy_weights(own, parent)._replace(models_opt_state=own.models_opt_state)

    # The pieces that `critic_step` composes.

    def expanded_target(self, state: Any, batch: Batch, key: Array) -> tuple[Array, Array]:
        """The target (B,) and the weights (H + 1, B) of the horizons in it."""
        return jax.lax.stop_gradient(combine(self.candidates(state, batch, key)))

    def candidates(self, state: Any, batch: Batch, key: Array) -> list[Array]:
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
            next_observation, _ = self.dynamics.predict(state.models, observation, action)
            transition = (state.models, observation, action, next_observation)
            paid = paid + factor * self.dynamics.reward(*transition)
            factor = factor * self.hyper.gamma * (1 - self.dynamics.terminated(*transition))
            step_key, observation = jax.random.fold_in(key, step), next_observation
            asked = jax.vmap(self.ask, (None, 0, None), (0, 1))
            action, value = asked(state, observation, step_key)
            found.append((paid + factor * value[:, None]).reshape(-1, len(batch.reward)))
        return found

    def ask(self, state: Any, observation: Array, key: Array) -> tuple[Array, Array]:
        """The target action (B, A) and what it is worth to each critic member (L, B)."""
        action = self.next_action(state, observation, key)
        values = self.values(state.target_critic, observation, action)
        return action, min_q(values.reshape(-1, self.hyper.critics, len(observation)), axis=1)

    def routes(self, rows: int) -> Array:
        """What a row counts for a critic, (critics, B): the mean over B is that over its own rows,
        every `critic_members`-th; a minibatch has them in any order.
        """
        members = jnp.arange(self.hyper.critic_members)
        own = (jnp.arange(rows) % len(members) == members[:, None]).astype(jnp.float32)
        return (own / own.mean(axis=1, keepdims=True)).repeat(self.hyper.critics, axis=0)

    def fit_models(self, state: Any, batch: Batch) -> tuple[State, Array]:
        """One Adam step of every model, each on every `models`-th row; their mean loss."""
        count = self.hyper.models
        models = self.dynamics.observe(state.models, batch)
        models, opt_state, loss = self.dynamics.step(
            models, state.models_opt_state, deal(batch, count)
        )
        return state._replace(models=models, models_opt_state=opt_state), loss


def deal(batch: Batch, count: int) -> Batch:
    """Every `count`-th row of a minibatch for each model, (count, rows, ...).

    A last round that is not full is filled up by rows of weight 0; the weights of the others then
    grow, so that a mean over `rows` is the mean of a model's own.
    """
    size = len(batch.reward)
    rows = -(-size // count)

    def dealt(x: Array) -> Array:
        return jnp.resize(x, (rows * count, *x.shape[1:])).reshape(rows, count, *x.shape[1:])

    own = (np.arange(rows * count) < size).reshape(rows, count)
    share = (own / own.mean(axis=0)).astype(np.float32)
    hands = jax.tree.map(dealt, batch)
    hands = hands._replace(weight=hands.weight * share)
    return jax.tree.map(lambda x: x.swapaxes(0, 1), hands)


def combine(candidates: Sequence[Array]) -> tuple[Array, Array]:
    """Targets (B,) and weights (H + 1, B) from the candidates (estimates, B) of each horizon."""
    mean = jnp.stack([each.mean(axis=0) for each in candidates])
    if len(mean) == 1:  # nothing to weigh, so that not even a last bit changes
        return mean[0], jnp.ones_like(mean)
    variance = jnp.stack([each.var(axis=0) for each in candidates])
    weight = 1 / (variance + SMALLEST_VARIANCE)
    weight = weight / weight.sum(axis=0)
    return (weight * mean).sum(axis=0), weight


@dataclass(frozen=True)
class STEVE(Expansion, ddpg.DDPG):
    """The learner of one member, over DDPG."""

    Hyper: ClassVar[type] = Hyper

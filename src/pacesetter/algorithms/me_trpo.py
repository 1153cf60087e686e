"""ME-TRPO (Kurutach et al. 2018), one member. Reference: thanard/me-trpo at 7dad9cd.

fit K models of the task to all real steps so far
repeat, on imagined steps from real starts, each through a model drawn at random:
    `check_every` updates of TRPO
    in each model alone, return of the mean action; if `share` of them say that it did not
        fall since the policy kept last, keep this one
until none was kept for `patience` updates; go on with the policy kept last
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import trpo
from pacesetter.algorithms.contract import Array, Learner, Update
from pacesetter.batch import Batch, Spec
from pacesetter.dynamics.fit import fit
from pacesetter.dynamics.imagined import Imagined
from pacesetter.dynamics.model import DETERMINISTIC, GAUSSIAN, Dynamics, Known, Models
from pacesetter.networks.trust_region import Gaussian
from pacesetter.policy import Actors
from pacesetter.settings import STRICT, ModelDriven, only
from pacesetter.settings.values import LARGEST_COUNTED, Count, SmallCount, SmallCountOr0, Width
from pacesetter.types import Floats


def _fits(horizon: int, info: ValidationInfo) -> int:
    """A policy update needs at least one imagined episode."""
    if horizon > (steps := info.data.get("imagined_steps", horizon)):
        raise ValueError(f"is longer than all imagined steps; allowed: up to {steps}")
    return horizon


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(ModelDriven, trpo.Hyper):
    """Smaller than published, so that two cores do; the preset me-trpo-paper has those sizes."""

    normalize_observation: Annotated[bool, only(False)] = Field(
        False, description="fixed: models and rewards see the task's own numbers"
    )
    models: int = Field(5, ge=1, le=1_000, description="models of the task")
    model_hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of a model's hidden layers"
    )
    model_learning_rate: float = Field(1e-3, gt=0, description="Adam learning rate of the models")
    model_noise: bool = Field(
        False,
        description="models also learn a standard deviation, with which imagined steps are drawn",
    )
    model_batch_size: SmallCount = Field(1000, description="rows per minibatch of a model")
    model_patience: SmallCount = Field(
        5,
        description="passes without a fall of the held-out loss by 1% that end a fit",
    )
    model_rows: Count = Field(
        250_000,
        ge=1,
        le=LARGEST_COUNTED,
        description="rows that all passes of one fit may go through together",
    )
    renew_every: SmallCountOr0 = Field(
        0, description="iterations between fits that begin with new weights; 0 never does"
    )
    imagined_steps: Count = Field(
        20_000,
        ge=1,
        le=LARGEST_COUNTED,
        description="imagined steps per policy update, rounded down to whole episodes of --horizon",
    )
    horizon: Annotated[int, AfterValidator(_fits)] = Field(
        1000, ge=1, validate_default=True, description="steps per imagined episode at most"
    )
    bootstrap: bool = Field(
        True, description="add the critic's value where an imagined episode is cut at --horizon"
    )
    policy_updates: SmallCount = Field(50, description="policy updates per iteration at most")
    check_every: SmallCount = Field(
        5, description="policy updates between evaluations in every model"
    )
    patience: SmallCount = Field(
        25, description="policy updates without a kept policy before the iteration ends"
    )
    share: float = Field(
        0.7,
        ge=0,
        le=1,
        description="share of models whose return must not fall for a policy to be kept",
    )
    critic_epochs: SmallCountOr0 = Field(5, description="passes of the critic over imagined steps")
    critic_batch_size: SmallCount = Field(
        1000, description="observations per minibatch of the critic"
    )


class State(NamedTuple):
    """TRPO's learner and the models."""

    learner: trpo.State
    models: Models
    updates: Array
    searched: Array  # policy updates in all
    fitted: Array  # passes of the models over their rows, in all


class Search(NamedTuple):
    """Where the policy's search in the models is."""

    learner: trpo.State
    kept: Gaussian
    returns: Array  # (K,) of the policy kept last
    stale: Array  # updates since then
    made: Array  # updates in all


@dataclass(frozen=True)
class METRPO(Learner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any
    known: Known | None = None  # what is known of the task replaces learned heads

    @classmethod
    def build(cls, spec: Spec, hyper: Any, known: Known | None = None) -> Self:
        return cls(spec, hyper, known)

    @cached_property
    def base(self) -> trpo.TRPO:
        """What improves the policy in the models."""
        return trpo.TRPO(self.spec, self.hyper)

    @cached_property
    def dynamics(self) -> Dynamics:
        """The models of the task."""
        hyper = self.hyper
        return Dynamics(
            self.spec,
            members=hyper.models,
            hidden=hyper.model_hidden,
            known=self.known,
            form=GAUSSIAN if hyper.model_noise else DETERMINISTIC,
            learning_rate=hyper.model_learning_rate,
        )

    @cached_property
    def imagined(self) -> Imagined:
        """The policy's episodes in the models."""
        hyper = self.hyper
        envs = max(hyper.imagined_steps // hyper.horizon, 1)
        return Imagined(self.dynamics, hyper.gamma, hyper.horizon, envs, hyper.bootstrap)

    def init(self, key: Array) -> State:
        learner_key, models_key = jax.random.split(key)
        models = self.dynamics.init(models_key)
        none = jnp.zeros((), jnp.int32)
        return State(self.base.init(learner_key), models, none, none, none)

    def policy_params(self, state: State) -> Gaussian:
        return state.learner.actor

    def act(
        self, params: Any, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        return self.base.act(params, noise_state, observation, rng)

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        """One iteration on all real steps, the first `valid` of (S, ...), and reset `starts`."""
        fit_key, search_key = jax.random.split(key)
        starts: Any = batch.starts
        models, epochs, losses = self.fit_models(state, batch, fit_key)
        search = self.search(state.learner, models, starts, search_key)
        losses |= {"imagined_return": search.returns.mean(), "search_updates": search.made * 1.0}
        learner = search.learner._replace(actor=search.kept)
        searched, fitted = state.searched + search.made, state.fitted + epochs
        new = State(learner, models, state.updates + 1, searched, fitted)
        return Update(new, losses, jnp.zeros((1, 1)))

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        (state,), hyper = states, self.hyper
        searched = int(state.searched)
        return {
            "resets": updates * hyper.starts,
            "policy_updates": searched,
            "imagined_steps": searched * self.imagined.envs * hyper.horizon,
            "model_epochs": int(state.fitted),
        }

    def restarted(self, state: State) -> State:
        return state._replace(
            searched=jnp.zeros_like(state.searched), fitted=jnp.zeros_like(state.fitted)
        )

    def policy(self, state: State) -> Actors:
        return self.base.policy(state.learner)

    # The pieces that `update` composes.

    def fit_models(
        self, state: State, batch: Batch, key: Array
    ) -> tuple[Models, Array, dict[str, Array]]:
        """The models after a fit to real steps, from where they are or, at times, from new ones,
        and its passes.
        """
        hyper, valid = self.hyper, jnp.asarray(batch.valid)
        models = state.models
        if hyper.renew_every:
            due = state.updates % hyper.renew_every == 0
            new_key, key = jax.random.split(key)
            new = self.dynamics.init(new_key)
            models = jax.tree.map(lambda new, old: jnp.where(due, new, old), new, models)
        # The env was given actions cut at +-1, so that is what changed the state.
        data = batch._replace(action=jnp.clip(batch.action, -1, 1))
        epochs = jnp.maximum(hyper.model_rows // valid, 1)
        found = fit(
            self.dynamics, models, data, key, hyper.model_batch_size, hyper.model_patience, epochs
        )
        losses = {"model_loss": found.loss.mean(), "fit_epochs": found.epochs * 1.0}
        return found.models, found.epochs, losses

    def search(self, learner: trpo.State, models: Models, starts: Array, key: Array) -> Search:
        """TRPO in the models until they no longer agree that it helps."""
        hyper = self.hyper
        # Each search explores anew, as in the reference.
        log_std = jnp.full_like(learner.actor.log_std, np.log(hyper.initial_std))
        learner = learner._replace(actor=learner.actor._replace(log_std=log_std))

        def update(i: Array, learner: trpo.State) -> trpo.State:
            imagine_key, update_key = jax.random.split(jax.random.fold_in(key, i))
            batch = self.imagined.rollout(models, learner.actor, starts, imagine_key)
            return self.base.update(learner, batch, update_key).state

        def go_on(search: Search) -> Array:
            return (search.stale < hyper.patience) & (search.made < hyper.policy_updates)

        def improve(search: Search) -> Search:
            made = jnp.minimum(search.made + hyper.check_every, hyper.policy_updates)
            learner = jax.lax.fori_loop(search.made, made, update, search.learner)
            returns = self.imagined.returns(models, learner.actor, starts)
            keep = agree(returns, search.returns, hyper.share)
            kept, returns = jax.tree.map(
                lambda new, old: jnp.where(keep, new, old),
                (learner.actor, returns),
                (search.kept, search.returns),
            )
            stale = jnp.where(keep, 0, search.stale + made - search.made)
            return Search(learner, kept, returns, stale, made)

        none = jnp.zeros((), jnp.int32)
        returns = self.imagined.returns(models, learner.actor, starts)
        begin = Search(learner, learner.actor, returns, none, none)
        return jax.lax.while_loop(go_on, improve, begin)


def agree(returns: Array, before: Array, share: float) -> Array:
    """Whether at least a share of the models (K,) sees no fall."""
    return (returns >= before).sum() >= share * len(returns) - 1e-6

"""SUNRISE over TD3, which is in no paper: what compares with Multi-TD3 like with like.

Everything of the ensemble is as in `sunrise`; its learners are TD3's, with their smoothed target
actions, their Gaussian noise on proposals and an actor update every `policy_delay` critic updates.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import jax.numpy as jnp
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import sunrise, td3
from pacesetter.algorithms.contract import Array
from pacesetter.batch import Batch, Spec
from pacesetter.settings import STRICT


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(sunrise.EnsembleHyper, td3.Hyper):
    """TD3's settings and the ensemble's."""

    exploration: Literal["gaussian"] = Field("gaussian", description="noise on proposed actions")


@dataclass(frozen=True)
class SunriseTD3(sunrise.Sunrise):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper

    @classmethod
    def build(cls, spec: Spec, hyper: Any) -> Self:
        return cls(spec, hyper, td3.TD3(spec, hyper))

    def next_action(self, state: td3.State, observation: Array, key: Array) -> tuple[Array, Array]:
        return self.base.next_action(state, observation, key), jnp.zeros(len(observation))

    def fit_actor(
        self, state: td3.State, batch: Batch, key: Array, weight: Array
    ) -> tuple[td3.State, dict[str, Array]]:
        """One learner's actor update, and that of its targets."""
        state, loss = self.base.fit_actor(state, batch, weight)
        return self.base.update_targets(state), {"actor_loss": loss}

    def _of_base(self, params: sunrise.Params) -> Any:
        return params.actor, ()

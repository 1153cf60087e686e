"""REDQ (Chen et al. 2021) over SAC: many critics, a random pair in the target, many updates.

PYTHONPATH=examples pacesetter train redq:REDQ Hopper-v5
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import sac
from pacesetter.algorithms.contract import Array, Update, each_minibatch, last_minibatch
from pacesetter.batch import Batch
from pacesetter.settings import STRICT
from pacesetter.settings.values import Count


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(sac.Hyper):
    """SAC's settings; the defaults that differ are the paper's for MuJoCo."""

    critics: int = Field(10, ge=2, le=100, description="critics, of which a target uses two")
    updates_per_step: float = Field(20.0, gt=0, le=1_000, description="critic updates per env step")
    policy_delay: int = Field(20, ge=1, le=1_000, description="critic updates per actor update")
    warmup: Count = Field(5_000, ge=0, description="first steps of all members, uniform actions")


@dataclass(frozen=True)
class REDQ(sac.SAC):
    Hyper: ClassVar[type] = Hyper

    @property
    def updates_per_call(self) -> int:
        return self.hyper.policy_delay

    def update(self, state: sac.State, batch: Batch, key: Array) -> Update:
        keys = jax.random.split(key, self.updates_per_call + 1)
        state, (loss, td_error) = each_minibatch(self.critic_step, state, batch, keys[:-1])
        state, losses = self.fit_actor(state, last_minibatch(batch), keys[-1])
        return Update(state, {"critic_loss": loss.mean(), **losses}, td_error)

    def next_q(self, outputs: Array, key: Array) -> Array:
        pair = jax.random.choice(key, len(outputs), (2,), replace=False)
        return self.head.min_q(outputs[pair])

    def actor_value(self, values: Array) -> Array:
        return values.mean(axis=0)

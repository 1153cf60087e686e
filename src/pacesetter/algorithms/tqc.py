"""TQC (Kuznetsov et al. 2020), one member: SAC whose target drops the largest quantiles.

    pool the quantiles of all N target critics at (s', a'), a' ~ pi(s'), and sort them
    drop the largest `dropped` * N; the rest, each r + discount * (it - alpha * log pi(a'|s')),
    is what the quantiles of every critic move towards
    move the actor up the mean of all quantiles of all critics

The largest quantiles are where critics overestimate most. Reference: SB3-contrib tqc.py.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import sac
from pacesetter.algorithms.contract import Array
from pacesetter.settings import STRICT


def _check_dropped(value: int, info: ValidationInfo) -> int:
    if value >= (quantiles := info.data.get("quantiles", value + 1)):
        raise ValueError(f"must leave a quantile of the {quantiles}; allowed: 0 to {quantiles - 1}")
    return value


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(sac.Hyper):
    """SAC's settings, and the paper's numbers of critics and quantiles."""

    replay: Literal["uniform", "prioritized", "return"] = Field(
        "uniform", description="sample transitions uniformly, by TD error (PER) or by return"
    )
    critics: int = Field(5, ge=1, le=100, description="critics, whose quantiles the target pools")
    quantiles: int = Field(25, ge=1, le=1_000, description="quantiles that each critic learns")
    dropped: Annotated[int, AfterValidator(_check_dropped)] = Field(
        2,
        ge=0,
        validate_default=True,
        description="largest quantiles to drop from the target, per critic",
    )


@dataclass(frozen=True)
class TQC(sac.SAC):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper

    def next_q(self, outputs: Array, key: Array) -> Array:
        """The smallest next quantiles (M', B) of all critics' outputs (N, B, M)."""
        critics, batch, quantiles = outputs.shape
        pooled = jnp.moveaxis(outputs, 1, 0).reshape(batch, critics * quantiles)
        kept = critics * (quantiles - self.hyper.dropped)
        return jnp.sort(pooled, axis=1)[:, :kept].T

    def actor_value(self, values: Any) -> Any:
        return values.mean(axis=0)

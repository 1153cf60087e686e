"""Critic heads: what a critic's outputs mean and what moves them towards a target.

A learner chooses its head once, when it is made, and asks it wherever outputs become numbers.
"""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
from pydantic import AfterValidator, Field, ValidationInfo

Array = jax.Array
LAP_KINK = 1.0  # where LAP's loss turns from square to line, and its smallest priority
KAPPA = 1.0  # the same for quantiles


def _have_one_loss(quantiles: int, info: ValidationInfo) -> int:
    if quantiles and info.data.get("replay") == "lap":
        raise ValueError("have a loss of their own, as has --replay lap; allowed with it: 0")
    return quantiles


Quantiles = Annotated[int, Field(ge=0, le=1_000), AfterValidator(_have_one_loss)]


class Head(NamedTuple):
    """A critic's last layer: how many outputs (..., M) it has and two functions of them.

    `value(outputs)` is the mean return (...), of NumPy arrays too. `loss(outputs, target)` of
    (..., B, M) and (B,) or (B, M) is each row's loss and absolute TD error, both (..., B).
    """

    outputs: int
    value: Callable[[Array], Array]
    loss: Callable[[Array, Array], tuple[Array, Array]]

    def least(self, outputs: Array) -> Array:
        """Of N critics' outputs (N, B, M), those (B, M) of the one with the lowest value.

        One output comes back as (B,): then this is the minimum of clipped double-Q.
        """
        if self.outputs == 1:
            return self.value(outputs).min(axis=0)
        lowest = self.value(outputs).argmin(axis=0)
        return jnp.take_along_axis(outputs, lowest[None, :, None], axis=0)[0]


def choose(quantiles: int, replay: str) -> Head:
    """The head of a learner: quantiles if it has any, else the mean with its replay's loss."""
    if quantiles:
        return Head(quantiles, mean, quantile_huber)
    return Head(1, first, lap if replay == "lap" else squared)


def first(outputs: Array) -> Array:
    """The only output (..., 1) as the value (...)."""
    return outputs[..., 0]


def mean(outputs: Array) -> Array:
    """The quantiles' mean as the value (...)."""
    return outputs.mean(axis=-1)


def squared(outputs: Array, target: Array) -> tuple[Array, Array]:
    """Squared TD error, without a factor 1/2."""
    error = outputs[..., 0] - target
    return error**2, jnp.abs(error)


def lap(outputs: Array, target: Array) -> tuple[Array, Array]:
    """e^2 / 2 below 1, |e| above (Fujimoto et al. 2020, LAP; sfujim/TD7).

    Its value jumps at 1; its gradient, which is all that matters, does not.
    """
    error = jnp.abs(outputs[..., 0] - target)
    return jnp.where(error < LAP_KINK, 0.5 * error**2, LAP_KINK * error), error


def quantile_huber(outputs: Array, target: Array) -> tuple[Array, Array]:
    """Quantile Huber loss (Dabney et al. 2018, QR-DQN, eq. 10); its TD error is that of means.

    Output i stands for the share (i + 1/2) / M. Summed over outputs, averaged over the target's
    numbers, so that a target (B,) counts as one certain return.
    """
    count = outputs.shape[-1]
    share = (jnp.arange(count, dtype=outputs.dtype) + 0.5) / count
    target = target.reshape(len(target), -1)
    error = target[:, None, :] - outputs[..., None]  # (..., B, M, M of the target)
    size = jnp.abs(error)
    huber = jnp.where(size < KAPPA, 0.5 * error**2, KAPPA * (size - 0.5 * KAPPA)) / KAPPA
    side = jnp.abs(share[:, None] - (error < 0))
    loss = (side * huber).mean(axis=-1).sum(axis=-1)
    return loss, jnp.abs(target.mean(axis=-1) - outputs.mean(axis=-1))

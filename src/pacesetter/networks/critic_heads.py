"""Critic heads: what a critic's outputs mean and which loss moves them towards a target.

A learner chooses its head once, when it is made, and asks it wherever outputs become values.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array
LAP_KINK = 1.0  # where LAP's loss turns from square to linear, and its smallest priority
KAPPA = 1.0  # the same for quantiles


def min_q(values: Any, axis: int = 0) -> Any:
    """The minimum over critics (clipped double Q), of JAX or NumPy values (critics, ...)."""
    return values.min(axis=axis)


class Head(NamedTuple):
    """A critic's last layer: how many outputs (..., M) it has and two functions of them.

    `value(outputs)` is the mean return (...), of NumPy arrays too. `loss(outputs, target_q)` of
    (..., B, M) and (B,) or (M, B) is each transition's loss and absolute TD error, both (..., B).
    """

    outputs: int
    value: Callable[[Array], Array]
    loss: Callable[[Array, Array], tuple[Array, Array]]

    def min_q(self, outputs: Array) -> Array:
        """Of N critics' outputs (N, B, M), those of the critic with the lowest value.

        One output per critic gives the minimum (B,); quantiles come as (M, B), so that rewards
        and discounts (B,) apply to either.
        """
        if self.outputs == 1:
            return min_q(self.value(outputs))
        lowest = self.value(outputs).argmin(axis=0)
        return jnp.take_along_axis(outputs, lowest[None, :, None], axis=0)[0].T


def choose(quantiles: int, replay: str) -> Head:
    """The head of a learner: quantiles if it has any, else the mean with its replay's loss."""
    if quantiles:
        return Head(quantiles, mean, _quantile_loss)
    return Head(1, first, lap if replay == "lap" else squared)


def first(outputs: Array) -> Array:
    """The only output (..., 1) as the value (...)."""
    return outputs[..., 0]


def mean(outputs: Array) -> Array:
    """The quantiles' mean as the value (...)."""
    return outputs.mean(axis=-1)


def squared(outputs: Array, target_q: Array) -> tuple[Array, Array]:
    """Squared TD error, without a factor 1/2."""
    td_error = outputs[..., 0] - target_q
    return td_error**2, jnp.abs(td_error)


def lap(outputs: Array, target_q: Array) -> tuple[Array, Array]:
    """e^2 / 2 below 1, |e| above (Fujimoto et al. 2020, LAP; sfujim/TD7).

    Its value jumps at 1; its gradient, which is all that matters, does not.
    """
    td_error = jnp.abs(outputs[..., 0] - target_q)
    return jnp.where(td_error < LAP_KINK, 0.5 * td_error**2, LAP_KINK * td_error), td_error


def quantile_huber(outputs: Array, target_q: Array) -> tuple[Array, Array]:
    """Quantile Huber loss (Dabney et al. 2018, QR-DQN, eq. 10); its TD error is that of means.

    `target_q` is (B, M), or (B,) for one certain return. Output i stands for the quantile
    (i + 1/2) / M. The loss is summed over outputs and averaged over the target's numbers.
    """
    count = outputs.shape[-1]
    quantile = (jnp.arange(count, dtype=outputs.dtype) + 0.5) / count
    target_q = target_q.reshape(len(target_q), -1)
    error = target_q[:, None, :] - outputs[..., None]  # (..., B, M, M of the target)
    size = jnp.abs(error)
    huber = jnp.where(size < KAPPA, 0.5 * error**2, KAPPA * (size - 0.5 * KAPPA)) / KAPPA
    side = jnp.abs(quantile[:, None] - (error < 0))
    loss = (side * huber).mean(axis=-1).sum(axis=-1)
    return loss, jnp.abs(target_q.mean(axis=-1) - outputs.mean(axis=-1))


def _quantile_loss(outputs: Array, target_q: Array) -> tuple[Array, Array]:
    """The same for a target (M, B), as `Head.min_q` leads to it."""
    return quantile_huber(outputs, target_q.T)

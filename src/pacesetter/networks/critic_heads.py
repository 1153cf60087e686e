"""Critic heads: what a critic's outputs mean and which loss moves them towards a target.

A learner chooses its head once, when it is made, and asks it wherever outputs become values.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pacesetter.networks.mlp import Array

LAP_KINK = 1.0  # where LAP's loss turns from square to linear, and its smallest priority
KAPPA = 1.0  # the same for quantiles
BINS_LIMIT = 5.0  # the return of the last bin, in units of the returns' standard deviation


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

    def weighted_loss(self, outputs: Array, target_q: Array, weight: Array) -> tuple[Array, Array]:
        """The weighted mean loss, summed over critics (N, B, M), and each transition's largest
        |TD error| (B,); weights are (B,) or (N, B).
        """
        losses, td_error = self.loss(outputs, target_q)
        return (weight * losses).mean(axis=1).sum(), td_error.max(axis=0)

    def min_q(self, outputs: Array) -> Array:
        """Of N critics' outputs (N, B, M), those of the critic with the lowest value.

        One output per critic gives the minimum (B,); quantiles come as (M, B), so that rewards
        and discounts (B,) apply to either.
        """
        if self.outputs == 1:
            return min_q(self.value(outputs))
        return self.lowest(outputs).T

    def lowest(self, outputs: Array) -> Array:
        """Of N critics' outputs (N, B, M), those (B, M) of the critic with the lowest value."""
        lowest = self.value(outputs).argmin(axis=0)
        return jnp.take_along_axis(outputs, lowest[None, :, None], axis=0)[0]

    def target(self, outputs: Array, reward: Array, discount: Array, bonus: Array) -> Array:
        """What `loss` moves towards: the reward plus the discounted lowest next value and bonus."""
        return reward + discount * (self.min_q(outputs) + bonus)


class Categorical(Head):
    """Outputs are logits of M bins of the return, from -5 to 5 (Bellemare et al. 2017, C51).

    A target is the lowest critic's distribution (B, M), its bins moved by reward, discount and
    bonus, and shared out among the bins beside each; what lies beyond the last goes to the last.
    Such critics need rewards whose discounted returns are of the size of 1.
    """

    def target(self, outputs: Array, reward: Array, discount: Array, bonus: Array) -> Array:
        bins, shares = bins_of(self.outputs), jax.nn.softmax(self.lowest(outputs))
        moved = reward[:, None] + discount[:, None] * (bins + bonus[:, None])
        return project(shares, moved)


def categorical(count: int) -> Head:
    """The head with so many bins."""
    return Categorical(count, _bins_mean, _bins_loss)


def bins_of(count: int) -> Array:
    """The returns (M,) that the bins stand for."""
    return jnp.linspace(-BINS_LIMIT, BINS_LIMIT, count)


def project(shares: Array, places: Array) -> Array:
    """Shares (B, M) that lie at places (B, M), as shares of the bins: linear between two bins."""
    count = shares.shape[-1]
    width = 2 * BINS_LIMIT / (count - 1)
    position = (jnp.clip(places, -BINS_LIMIT, BINS_LIMIT) + BINS_LIMIT) / width
    near = jnp.clip(1 - jnp.abs(position[..., None] - jnp.arange(count)), 0, 1)  # (B, M, M)
    return (shares[..., None] * near).sum(axis=-2)


def _bins_mean(outputs: Array) -> Array:
    """The distribution's mean as the value (...)."""
    return (jax.nn.softmax(outputs) * bins_of(outputs.shape[-1])).sum(axis=-1)


def _bins_loss(outputs: Array, target_q: Array) -> tuple[Array, Array]:
    """Cross-entropy to the target's shares (B, M); its TD error is that of means."""
    loss = -(target_q * jax.nn.log_softmax(outputs)).sum(axis=-1)
    mean_of_target = (target_q * bins_of(target_q.shape[-1])).sum(axis=-1)
    return loss, jnp.abs(mean_of_target - _bins_mean(outputs))


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

"""A Gaussian policy, and how far a step may take it (Schulman et al. 2015, appendix C)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg

from pacesetter.networks import mlp
from pacesetter.networks.mlp import Array


class Gaussian(NamedTuple):
    """A policy: a tanh network of the mean (A,), and a log standard deviation (A,) of its own."""

    network: mlp.Network
    log_std: Array


# A diagonal Gaussian: its mean (B, A) and log standard deviation (A,).
Distribution = tuple[Array, Array]


def distribution_of(actor: Gaussian, observation: Array) -> Distribution:
    return mlp.apply(actor.network, observation, jnp.tanh), actor.log_std


def log_probability(distribution: Distribution, action: Array) -> Array:
    """log pi (B,) of actions (B, A), which are not clipped."""
    mean, log_std = distribution
    distance = (action - mean) * jnp.exp(-log_std)
    return -(0.5 * distance**2 + log_std + 0.5 * jnp.log(2 * jnp.pi)).sum(axis=-1)


def kl(old: Distribution, new: Distribution) -> Array:
    """Mean over B of KL(old || new)."""
    (old_mean, old_log_std), (mean, log_std) = old, new
    squares = jnp.exp(2 * old_log_std) + (old_mean - mean) ** 2
    each = log_std - old_log_std + 0.5 * squares * jnp.exp(-2 * log_std) - 0.5
    return each.sum(axis=-1).mean()


def fisher_product(
    distribution: Callable[[Array], Distribution], parameters: Array
) -> Callable[[Array], Array]:
    """v -> Fv, where F is the Hessian of the mean KL from `parameters` to themselves.

    F = J'MJ exactly, with J the Jacobian of mean and log standard deviation, and M the Fisher
    matrix of a Gaussian in those, which is diagonal: 1 / std^2 and 2.
    """
    (mean, log_std), jacobian = jax.linearize(distribution, parameters)
    transposed = jax.linear_transpose(jacobian, parameters)

    def product(vector: Array) -> Array:
        mean_change, log_std_change = jacobian(vector)
        weighted = mean_change * jnp.exp(-2 * log_std) / len(mean)
        return transposed((weighted, 2 * log_std_change))[0]

    return product


def natural_step(
    fisher: Callable[[Array], Array],
    gradient: Array,
    damping: float,
    max_kl: float,
    iterations: int,
) -> Array:
    """The step along the natural gradient whose KL, by its quadratic model, is `max_kl`."""

    def damped(vector: Array) -> Array:
        return fisher(vector) + damping * vector

    direction, _ = cg(damped, gradient, tol=1e-6, maxiter=iterations)
    # Without a gradient there is no direction, and no 0 / 0 either.
    curvature = jnp.maximum(direction @ damped(direction), jnp.finfo(jnp.float32).tiny)
    return jnp.sqrt(2 * max_kl / curvature) * direction


def line_search(
    judge: Callable[[Array], tuple[Array, Array]],
    start: Array,
    step: Array,
    ratio: float,
    tries: int,
) -> tuple[Array, Array, Array]:
    """The first of start + ratio^j * step that `judge` takes, whether any was, and its measures.

    If none of j < tries is taken: start, False and zeros.
    """

    def goes_on(carry: Any) -> Array:
        j, _, accepted, _ = carry
        return ~accepted & (j < tries)

    def attempt(carry: Any) -> Any:
        j, *_ = carry
        candidate = start + ratio**j * step
        return j + 1, candidate, *judge(candidate)

    _, measures = jax.eval_shape(judge, start)
    nothing = jnp.zeros(measures.shape, measures.dtype)
    begin = (jnp.zeros((), jnp.int32), start, jnp.array(False), nothing)
    _, candidate, accepted, measures = jax.lax.while_loop(goes_on, attempt, begin)
    return (
        jnp.where(accepted, candidate, start),
        accepted,
        jnp.where(accepted, measures, nothing),
    )

"""Layer norm: exact where the mean is far larger than the spread, values and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pacesetter.networks.mlp import standardize


def exact(x: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """In float64: the normalised vectors, and the gradient of their weighted sum."""
    x, weight = x.astype(np.float64), weight.astype(np.float64)
    centred = x - x.mean(axis=-1, keepdims=True)
    scale = 1 / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
    standard = centred * scale
    along = (weight * standard).mean(axis=-1, keepdims=True)
    return standard, scale * (weight - weight.mean(axis=-1, keepdims=True) - standard * along)


@pytest.mark.parametrize(("mean", "spread"), [(0, 1), (10, 1), (100, 0.1), (1000, 0.1), (0, 1e-4)])
def test_layer_norm_is_exact_far_from_zero(
    mean: float, spread: float, rng: np.random.Generator
) -> None:
    """E x^2 - (E x)^2 would be 10% off at 100 / 0.1 and 30 times too large at 1000 / 0.1."""
    x = (mean + spread * rng.normal(size=(8, 256))).astype(np.float32)
    weight = rng.normal(size=x.shape).astype(np.float32)
    value, gradient = exact(x, weight)
    # What float32 inputs leave of it: half a unit in the last place of the mean, over the spread.
    tolerance = 5e-6 + 2e-7 * mean / spread
    np.testing.assert_allclose(standardize(x), value, atol=tolerance)
    slope = jax.grad(lambda x: (standardize(x) * jnp.asarray(weight)).sum())(x)
    np.testing.assert_allclose(slope, gradient, atol=tolerance * np.abs(gradient).max())

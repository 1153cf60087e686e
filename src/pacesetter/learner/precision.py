"""Matrix products of any function in bfloat16, with sums, parameters and all else in float32."""

import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax.numpy as jnp
from jax.extend.core import JaxprEqn
from jax.extend.core.primitives import dot_general_p

from pacesetter.learner.rewriting import rewritten

P = ParamSpec("P")
R = TypeVar("R")
SMALL = 64  # products with a side below it gain nothing, as those of a few observed numbers


def bfloat16_products(function: Callable[P, R]) -> Callable[P, R]:
    """`function` whose float32 products round their operands to bfloat16 first."""
    return rewritten(function, _rounded)


def _rounded(equation: JaxprEqn, inputs: list[Any]) -> Any:
    if equation.primitive is not dot_general_p or not _is_large(equation):
        return None
    low = [x.astype(jnp.bfloat16) for x in inputs]
    return dot_general_p.bind(*low, **equation.params | {"preferred_element_type": jnp.float32})


def _is_large(product: JaxprEqn) -> bool:
    """Whether rows, columns and terms of a float32 product are all worth it."""
    matrices: list[Any] = [variable.aval for variable in product.invars]
    if any(matrix.dtype != jnp.float32 for matrix in matrices):
        return False
    contracted, batch = product.params["dimension_numbers"]
    sides = [[matrices[0].shape[axis] for axis in contracted[0]]]
    for matrix, summed, shared in zip(matrices, contracted, batch, strict=True):
        sides.append([n for axis, n in enumerate(matrix.shape) if axis not in (*summed, *shared)])
    return all(math.prod(side) >= SMALL for side in sides)

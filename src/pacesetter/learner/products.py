"""Matrix products of any function by libxsmm, a library that XLA then calls, in float32."""

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import JaxprEqn
from jax.extend.core.primitives import dot_general_p

from pacesetter.learner.rewriting import rewritten

P = ParamSpec("P")
R = TypeVar("R")
FILE = Path(__file__).with_name("libproducts.so")  # hatch_build.py makes it
TARGET = "pacesetter_product"
LEAST = 16  # sides below it are for XLA: no vector of numbers fits into them


def libxsmm_products(function: Callable[P, R]) -> Callable[P, R]:
    """`function` whose float32 products of matrices, one or several, libxsmm makes."""
    return rewritten(function, _foreign)


@cache
def library() -> Any:
    """The compiled products, known to XLA; None where they have not been built."""
    try:
        found = ctypes.CDLL(str(FILE))
    except OSError:
        return None
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(found.product), platform="cpu")
    return found


def _foreign(equation: JaxprEqn, inputs: list[Any]) -> Any:
    if equation.primitive is not dot_general_p:
        return None
    left, right = inputs
    if left.dtype != jnp.float32 or right.dtype != jnp.float32 or left.ndim != right.ndim:
        return None
    (left_sum, right_sum), (left_shared, right_shared) = equation.params["dimension_numbers"]
    shared = tuple(range(left.ndim - 2))
    if tuple(left_shared) != shared or tuple(right_shared) != shared or len(left_sum) != 1:
        return None
    left_t, right_t = left_sum[0] == len(shared), right_sum[0] == len(shared) + 1
    if left_t:  # of weights: JAX makes it transposed and turns it then; these two turns cancel
        if right_t:
            return None
        found = _product(right, left, True, False)
        return None if found is None else jnp.swapaxes(found, -1, -2)
    return _product(left, right, False, right_t)


def _product(left: Any, right: Any, left_t: bool, right_t: bool) -> Any:
    m, k = left.shape[-2:][:: -1 if left_t else 1]
    n = right.shape[-2 if right_t else -1]
    if min(m, n, k) < LEAST or not library().fits(m, n, k, left_t, right_t):
        return None
    shape = jax.ShapeDtypeStruct((*left.shape[:-2], m, n), jnp.float32)
    return jax.ffi.ffi_call(TARGET, shape)(left, right, left_t=left_t, right_t=right_t)

"""Float32 matrix products of a finished program by libxsmm, which XLA then calls, if asked for.

`products.cc` is built when pacesetter is installed, where that is possible (hatch_build.py).
"""

import ctypes
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar, get_args

import jax
import jax.numpy as jnp
from jax.extend.core import JaxprEqn
from jax.extend.core.primitives import dot_general_p

from pacesetter.errors import unknown
from pacesetter.learner.backend import platform
from pacesetter.learner.rewriting import rewritten

P = ParamSpec("P")
R = TypeVar("R")
Way = Literal["libxsmm", "xla"]
VARIABLE = "PACESETTER_PRODUCTS"
FILE = Path(__file__).with_name("libproducts.so")
TARGET = "pacesetter_product"
LEAST = 16  # products with a side below it stay XLA's
ABSENT = f"{VARIABLE}: libxsmm is not built in, so XLA makes all products; see docs/products.md"


def way(precision: str = "f32") -> Way:
    """Who makes the float32 products of updates; it decides their last bits."""
    return "libxsmm" if _wanted(precision) and library() else "xla"


def of(hyper: Any) -> Way:
    """The same for a run's settings."""
    return way(getattr(hyper, "precision", "f32"))


def notes(hyper: Any) -> list[str]:
    """What a person should know of it: a line if libxsmm is asked for and absent."""
    wanted = _wanted(getattr(hyper, "precision", "f32"))
    return [ABSENT] if wanted and not library() else []


def _wanted(precision: str) -> bool:
    value = os.environ.get(VARIABLE) or "xla"
    if value not in get_args(Way):
        raise unknown(VARIABLE, value, get_args(Way))
    return value == "libxsmm" and precision == "f32" and platform() == "cpu"


def libxsmm_products(function: Callable[P, R]) -> Callable[P, R]:
    """`function` whose float32 products of matrices, or of stacks of them, libxsmm makes."""
    return rewritten(function, _by_libxsmm)


@cache
def library() -> Any:
    """The compiled products, made known to XLA; None where there are none that it can use."""
    try:
        found = ctypes.CDLL(str(FILE))
        found.fits.restype = ctypes.c_bool
        jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(found.product), platform="cpu")
    except (OSError, AttributeError, jax.errors.JaxRuntimeError):
        return None
    return found


def _by_libxsmm(equation: JaxprEqn, inputs: list[Any]) -> Any:
    if equation.primitive is not dot_general_p:
        return None
    left, right = inputs
    (left_sum, right_sum), (left_shared, right_shared) = equation.params["dimension_numbers"]
    shared = tuple(range(left.ndim - 2))
    of_matrices = left.ndim == right.ndim >= 2 and len(left_sum) == 1
    if not of_matrices or not shared == tuple(left_shared) == tuple(right_shared):
        return None
    left_t, right_t = left_sum[0] == len(shared), right_sum[0] == len(shared) + 1
    if not left_t:
        return _product(left, right, right_t=right_t)
    if right_t:
        return None
    # A gradient of weights, which JAX makes transposed and then turns: the two turns cancel.
    found = _product(right, left, left_t=True)
    return None if found is None else jnp.swapaxes(found, -1, -2)


def _product(left: Any, right: Any, *, left_t: bool = False, right_t: bool = False) -> Any:
    """(..., m, k) times (..., k, n), each as it is or stored transposed; None if it is XLA's."""
    m, k = left.shape[-2:][:: -1 if left_t else 1]
    n = right.shape[-2 if right_t else -1]
    if left.dtype != jnp.float32 or right.dtype != jnp.float32 or not left.size:
        return None
    if min(m, n, k) < LEAST or not library().fits(m, n, k, left_t, right_t):
        return None
    shape = jax.ShapeDtypeStruct((*left.shape[:-2], m, n), jnp.float32)
    return jax.ffi.ffi_call(TARGET, shape)(left, right, left_t=left_t, right_t=right_t)

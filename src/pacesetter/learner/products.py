"""Matrix products of a finished program by another library than XLA, which XLA then calls.

libxsmm makes float32 products, if asked for; oneDNN those of `--precision bf16`, unless another is.
`products.cc` and `bfloat16.cc` call them. They are built when pacesetter is installed, where that
is possible (hatch_build.py).
"""

import ctypes
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar, get_args

import jax
import jax.numpy as jnp
from jax.extend.core import JaxprEqn
from jax.extend.core.primitives import dot_general_p

from pacesetter.errors import unknown
from pacesetter.learner.backend import platform
from pacesetter.learner.rewriting import rewritten

P = ParamSpec("P")
R = TypeVar("R")
Way = Literal["libxsmm", "onednn", "xla"]
VARIABLE = "PACESETTER_PRODUCTS"
LEAST = 16  # products with a side below it stay XLA's
USUAL = (256, 256, 256)  # the product of which a processor must know how to make it


class Library(NamedTuple):
    """Who makes products other than XLA."""

    file: Path  # what calls it
    precision: str  # of updates whose products it makes
    operands: Any  # their type
    target: str  # the name by which XLA calls it
    needs: tuple[str, ...] = ()  # where its own file may be, first of all


HERE = Path(__file__).parent
LIBRARIES: dict[Way, Library] = {
    "libxsmm": Library(HERE / "libproducts.so", "f32", jnp.float32, "pacesetter_product"),
    "onednn": Library(
        HERE / "libbfloat16.so",
        "bf16",
        jnp.bfloat16,
        "pacesetter_bfloat16_product",
        (f"{sys.prefix}/lib/libdnnl.so.3", "libdnnl.so.3"),  # of pip's package, or the system's
    ),
}


def way(precision: str = "f32") -> Way:
    """Who makes the products of updates in a precision; it decides their last bits."""
    for name, library in LIBRARIES.items():
        if library.precision == precision and _wanted(name) and loaded(name):
            return name
    return "xla"


def of(hyper: Any) -> Way:
    """The same for a run's settings."""
    return way(_precision(hyper))


def notes(hyper: Any) -> list[str]:
    """What a person should know of it: a line if a library is asked for by name and absent."""
    return [
        f"{VARIABLE}: {name} is not built in, or not for this processor, so XLA makes all "
        "products; see docs/products.md"
        for name, library in LIBRARIES.items()
        if os.environ.get(VARIABLE) == name
        and library.precision == _precision(hyper)
        and _wanted(name)
        and not loaded(name)
    ]


def _precision(hyper: Any) -> str:
    return getattr(hyper, "precision", "f32")


def _wanted(name: Way) -> bool:
    """Whether a library is asked for; oneDNN is, unless another is."""
    value = os.environ.get(VARIABLE) or "onednn"
    if value not in get_args(Way):
        raise unknown(VARIABLE, value, get_args(Way))
    return value == name and platform() == "cpu"


def by_library(function: Callable[P, R], precision: str) -> Callable[P, R]:
    """`function` whose products of matrices, or of stacks of them, are made as `way` says."""
    made_by = way(precision)
    return function if made_by == "xla" else rewritten(function, partial(_product_by, made_by))


@cache
def loaded(name: Way) -> Any:
    """The compiled products, made known to XLA; None where this processor has none to use."""
    library = LIBRARIES[name]
    for needed in library.needs:
        with suppress(OSError):
            ctypes.CDLL(needed, mode=ctypes.RTLD_GLOBAL)
            break
    try:
        found = ctypes.CDLL(str(library.file))
        found.fits.restype = ctypes.c_bool
        jax.ffi.register_ffi_target(
            library.target, jax.ffi.pycapsule(found.product), platform="cpu"
        )
    except (OSError, AttributeError, jax.errors.JaxRuntimeError):
        return None
    return found if found.fits(*USUAL, False, False) else None


def _product_by(made_by: Way, equation: JaxprEqn, inputs: list[Any]) -> Any:
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
        return _product(made_by, left, right, right_t=right_t)
    if right_t:
        return None
    # A gradient of weights, which JAX makes transposed and then turns: the two turns cancel.
    found = _product(made_by, right, left, left_t=True)
    return None if found is None else jnp.swapaxes(found, -1, -2)


def _product(
    made_by: Way, left: Any, right: Any, *, left_t: bool = False, right_t: bool = False
) -> Any:
    """(..., m, k) times (..., k, n), each as it is or stored transposed; None if it is XLA's."""
    library = LIBRARIES[made_by]
    m, k = left.shape[-2:][:: -1 if left_t else 1]
    n = right.shape[-2 if right_t else -1]
    if left.dtype != library.operands or right.dtype != library.operands or not left.size:
        return None
    if min(m, n, k) < LEAST or not loaded(made_by).fits(m, n, k, left_t, right_t):
        return None
    shape = jax.ShapeDtypeStruct((*left.shape[:-2], m, n), jnp.float32)
    return jax.ffi.ffi_call(library.target, shape)(left, right, left_t=left_t, right_t=right_t)

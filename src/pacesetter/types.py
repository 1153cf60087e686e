"""Names for the arrays that every part of the program hands on, and how large their numbers may be.

What lies beyond is a fault, though float32 could hold it. Imports no JAX.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Reals = NDArray[np.float64]
Numbers = NDArray[np.int64]
Arrays = dict[str, NDArray[Any]]
Shape = tuple[int, ...]
Layers = Sequence[dict[str, Floats]]

# Of observations, rewards and actions: a loss squares what it is made of.
LARGEST = float(np.sqrt(np.finfo(np.float32).max))
# Of losses, weights and moments: so near to infinity that the next products reach it.
DIVERGED = 1e30
DIVERGENCE = (  # why, and what a person can do
    "learning has diverged, and resume would repeat it; train under another --name with smaller "
    "learning rates"
)
ALLOWED = f"finite and at most {LARGEST:.1e} in size"


def worst(array: NDArray[Any], limit: float) -> float | None:
    """A number of an array that is NaN or beyond +-limit; None if there is none."""
    if not array.size:
        return None
    ends = float(array.min()), float(array.max())  # NaN, if there is one
    return next((end for end in ends if not abs(end) <= limit), None)

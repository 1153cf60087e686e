"""How large a run's numbers may be: what lies beyond is a fault, though float32 could hold it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Of observations, rewards and actions: a loss squares what it is made of.
LARGEST = float(np.sqrt(np.finfo(np.float32).max))
# Of losses, weights and moments: so near to infinity that the next products reach it.
DIVERGED = 1e30
ALLOWED = f"finite and at most {LARGEST:.1e} in size"


def worst(array: NDArray[Any], limit: float) -> float | None:
    """A number of an array that is NaN or beyond +-limit; None if there is none."""
    if not array.size:
        return None
    ends = float(array.min()), float(array.max())  # NaN, if there is one
    return next((end for end in ends if not abs(end) <= limit), None)

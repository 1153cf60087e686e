"""Names for the arrays that every part of the program hands on; imports no JAX."""

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

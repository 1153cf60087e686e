"""How sure a selection was: the gap between members and the standard error of that gap."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

REMEMBERED = 20


@dataclass(frozen=True)
class Gap:
    """Best mean return minus the next, and the standard error of such a difference."""

    gap: float
    standard_error: float


def measure(returns: NDArray[np.float64], deviations: list[float]) -> Gap:
    """The gap of one selection from returns (K, n); adds to `deviations`, the last 20 variances.

    With n > 1 episodes a member, the variance is that of a member's own episodes. With one, it is
    that between the members, pooled over the last selections: after a copy they are clones, so
    their spread is noise, and if they are not, the error is overstated.
    """
    episodes = returns.shape[1]
    means = np.sort(returns.mean(axis=1))
    spread = returns.var(axis=1, ddof=1).mean() if episodes > 1 else returns.var(ddof=1)
    deviations.append(float(spread))
    del deviations[:-REMEMBERED]
    error = float(np.sqrt(2 * np.mean(deviations) / episodes))
    return Gap(float(means[-1] - means[-2]), error)

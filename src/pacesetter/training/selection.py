"""One selection and how sure it was: the gap between members and the standard error of that gap."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

REMEMBERED = 20


class Selection(NamedTuple):
    """Who starts again from whom, and on what grounds; returns are (K, episodes)."""

    parents: list[int]
    champion: int
    returns: list[list[float]]
    gap: float
    standard_error: float


def measure(returns: NDArray[np.float64], variances: list[float]) -> tuple[float, float]:
    """Best mean return minus the next, and the standard error of such a difference.

    With n > 1 episodes a member, the variance is that of a member's own episodes. With one, it is
    that between the members: after a copy they are clones, so their spread is noise, and where
    they are not, the error is overstated. Either is pooled over the last 20 selections, which
    `variances` remembers.
    """
    episodes = returns.shape[1]
    means = np.sort(returns.mean(axis=1))
    spread = returns.var(axis=1, ddof=1).mean() if episodes > 1 else returns.var(ddof=1)
    variances.append(float(spread))
    del variances[:-REMEMBERED]
    error = float(np.sqrt(2 * np.mean(variances) / episodes))
    return float(means[-1] - means[-2]), error

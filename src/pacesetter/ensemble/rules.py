"""Which member each member starts again from: returns (K,) -> parents (K,)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Returns = NDArray[np.float64]
Parents = NDArray[np.int64]
Rule = Callable[[Returns, np.random.Generator], Parents]


def none(returns: Returns, rng: np.random.Generator) -> Parents:
    """Everybody goes on as they are: a shared replay without selection."""
    return np.arange(len(returns))


def best(returns: Returns, rng: np.random.Generator) -> Parents:
    """All start again from the largest return, ties to the lowest index (Multi-TD3, III-B)."""
    return np.full(len(returns), np.argmax(returns))


def random(returns: Returns, rng: np.random.Generator) -> Parents:
    """All start again from one member drawn blindly: the placebo of `best`."""
    return np.full(len(returns), rng.integers(len(returns)))


def top_half(returns: Returns, rng: np.random.Generator) -> Parents:
    """The better half stays; each of the others starts again from one of it, best first."""
    order = np.argsort(-returns, kind="stable")
    half = (len(returns) + 1) // 2
    parents = np.arange(len(returns))
    parents[order[half:]] = order[: len(returns) - half]
    return parents


def tournament(returns: Returns, rng: np.random.Generator) -> Parents:
    """Each place goes to the better of two members drawn for it, ties to the lowest index."""
    pairs = np.sort(rng.integers(len(returns), size=(len(returns), 2)), axis=1)
    return np.where(returns[pairs[:, 1]] > returns[pairs[:, 0]], pairs[:, 1], pairs[:, 0])


RULES: dict[str, Rule] = {
    "none": none,
    "best": best,
    "random": random,
    "top_half": top_half,
    "tournament": tournament,
}

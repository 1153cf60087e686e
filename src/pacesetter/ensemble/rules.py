"""Who starts again from whom: a rule maps the members' returns (K,) to a choice."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Returns = NDArray[np.float64]
Parents = NDArray[np.int64]


class Choice(NamedTuple):
    """What a rule decides. A rule that only copies may return its parents alone.

    With `weights` (K, K), the new networks of member k are the mean of all, weighted by row k, and
    the parent gives what cannot be averaged, such as counters. `scales` has K factors per name of
    a learning rate; they multiply those that member k takes over from its parent.
    """

    parents: Parents  # (K,)
    weights: NDArray[np.float64] | None = None
    scales: dict[str, NDArray[np.float64]] | None = None


Rule = Callable[[Returns, np.random.Generator], Parents | Choice]


def none(returns: Returns, rng: np.random.Generator) -> Parents:
    """Everybody goes on as they are: a shared replay without selection."""
    return np.arange(len(returns))


def best(returns: Returns, rng: np.random.Generator) -> Parents:
    """All start again from the largest return, ties to the lowest index (Multi-TD3, III-B)."""
    return np.full(len(returns), np.argmax(returns))


def random(returns: Returns, rng: np.random.Generator) -> Parents:
    """All start again from one member drawn at random: the placebo of `best`."""
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


def average(returns: Returns, rng: np.random.Generator) -> Choice:
    """All start again from the mean of the better half's networks."""
    count = len(returns)
    better = np.argsort(-returns, kind="stable")[: (count + 1) // 2]
    weights = np.zeros((count, count))
    weights[:, better] = 1 / len(better)
    return Choice(np.full(count, better[0]), weights)


RULES: dict[str, Rule] = {
    "none": none,
    "best": best,
    "random": random,
    "top_half": top_half,
    "tournament": tournament,
    "average": average,
}


def choose(rule: str, returns: Returns, rng: np.random.Generator) -> Choice:
    """A rule's choice."""
    found = RULES[rule](returns, rng)
    return found if isinstance(found, Choice) else Choice(found)

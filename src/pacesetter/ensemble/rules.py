"""Who starts again from whom: a rule maps the members' returns (K, episodes) to a choice."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Returns = NDArray[np.float64]
Parents = NDArray[np.int64]

RESCUE_SHARE = 0.4  # of the best mean return
RESCUE_ERRORS = 2.0


class Choice(NamedTuple):
    """What a rule decides. A rule that only copies may return its parents alone.

    With `weights` (K, K), the new networks of member k are the mean of all, weighted by row k, and
    the parent gives what cannot be averaged, such as counters. `scales` has K factors per name of
    a learning rate or of a setting that varies: with them, member k takes over its parent's
    settings, times these. `perturb` asks for random factors for some members (K,), and so for the
    same. Without either, every member keeps its own settings.
    """

    parents: Parents  # (K,)
    weights: NDArray[np.float64] | None = None
    scales: dict[str, NDArray[np.float64]] | None = None
    perturb: NDArray[np.bool_] | None = None


Rule = Callable[[Returns, np.random.Generator], Parents | Choice]


def none(returns: Returns, rng: np.random.Generator) -> Parents:
    """Everybody goes on as they are: a shared replay without selection."""
    return np.arange(len(returns))


def best(returns: Returns, rng: np.random.Generator) -> Parents:
    """All start again from the largest mean return, ties to the lowest index (Multi-TD3, III-B)."""
    return np.full(len(returns), np.argmax(returns.mean(axis=1)))


def random(returns: Returns, rng: np.random.Generator) -> Parents:
    """All start again from one member drawn at random: the placebo of `best`."""
    return np.full(len(returns), rng.integers(len(returns)))


def top_half(returns: Returns, rng: np.random.Generator) -> Parents:
    """The better half stays; each of the others starts again from one of it, best first."""
    order = np.argsort(-returns.mean(axis=1), kind="stable")
    half = (len(returns) + 1) // 2
    parents = np.arange(len(returns))
    parents[order[half:]] = order[: len(returns) - half]
    return parents


def tournament(returns: Returns, rng: np.random.Generator) -> Parents:
    """Each place goes to the better of two members drawn for it, ties to the lowest index."""
    means = returns.mean(axis=1)
    pairs = np.sort(rng.integers(len(means), size=(len(means), 2)), axis=1)
    return np.where(means[pairs[:, 1]] > means[pairs[:, 0]], pairs[:, 1], pairs[:, 0])


def average(returns: Returns, rng: np.random.Generator) -> Choice:
    """All start again from the mean of the better half's networks."""
    count = len(returns)
    better = np.argsort(-returns.mean(axis=1), kind="stable")[: (count + 1) // 2]
    weights = np.zeros((count, count))
    weights[:, better] = 1 / len(better)
    return Choice(np.full(count, better[0]), weights)


def rescue(returns: Returns, rng: np.random.Generator) -> Parents:
    """Only a member far below the best starts again from it: below 60% and two standard errors.

    "Below 60%" is a gap of more than 40% of the best mean return's size, whatever its sign: below
    60 where the best has 100, below -140 where it has -100. The standard error is that of the
    difference of two means, from each one's own episodes (Welch), of which there must be two.
    """
    episodes = returns.shape[1]
    means, variances = returns.mean(axis=1), returns.var(axis=1, ddof=1) / episodes
    top = np.argmax(means)
    gap, error = means[top] - means, np.sqrt(variances + variances[top])
    fallen = (gap > RESCUE_SHARE * abs(means[top])) & (gap > RESCUE_ERRORS * error)
    return np.where(fallen, top, np.arange(len(returns)))


def pbt(returns: Returns, rng: np.random.Generator) -> Choice:
    """The worst fifth starts again from members drawn of the best fifth, with perturbed settings.

    Either fifth has at least one member; settings are those of --vary. Truncation selection, as in
    population-based training (Jaderberg et al. 2017).
    """
    order = np.argsort(-returns.mean(axis=1), kind="stable")
    count = max(len(order) // 5, 1)
    parents = np.arange(len(order))
    parents[order[len(order) - count :]] = rng.choice(order[:count], size=count)
    return Choice(parents, perturb=parents != np.arange(len(order)))


RULES: dict[str, Rule] = {
    "none": none,
    "best": best,
    "random": random,
    "top_half": top_half,
    "tournament": tournament,
    "average": average,
    "rescue": rescue,
    "pbt": pbt,
}


def choose(rule: str, returns: Returns, rng: np.random.Generator) -> Choice:
    """A rule's choice."""
    found = RULES[rule](returns, rng)
    return found if isinstance(found, Choice) else Choice(found)

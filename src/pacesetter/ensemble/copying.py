"""Members that start again from others: what is copied, and that no two share a buffer."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter.algorithms.contract import Learner
from pacesetter.ensemble.rules import Parents
from pacesetter.types import Reals


def copy_from_parents(
    learner: Learner,
    states: Sequence[Any],
    parents: Parents,
    copy: str,
    weights: Reals | None = None,
) -> list[Any]:
    """Each member's new state. A member that is its own parent is unchanged; from another, `full`
    copies the whole state, `weights` leaves a member its own optimiser state, and `actor` copies
    only the parent's actor. With `weights` (K, K) everyone's parent is a mean of states.
    """
    if weights is not None:
        sources = [mean_state(states, row, k) for row, k in zip(weights, parents, strict=True)]
        return [_copied(learner, *pair, copy) for pair in zip(states, sources, strict=True)]
    return [
        own if parent == member else _copied(learner, own, states[parent], copy)
        for member, (own, parent) in enumerate(zip(states, parents, strict=True))
    ]


def check_copy(learner: Learner, states: Sequence[Any], copy: str) -> None:
    """Refuse, before anything is trained, a way of copying that a learner does not know."""
    if copy != "full" and len(states) > 1:
        jax.eval_shape(partial(_copied, learner, copy=copy), states[0], states[1])


def mean_state(states: Sequence[Any], weights: Reals, best: int) -> Any:
    """The weighted mean of all floating-point leaves; other leaves, such as counters, are those
    of the best."""
    used = [int(k) for k in np.flatnonzero(weights)]

    def mean(of_best: Any, *leaves: Any) -> Any:
        if not jnp.issubdtype(of_best.dtype, jnp.floating):
            return of_best
        return sum(jnp.asarray(weights[k], x.dtype) * x for k, x in zip(used, leaves, strict=True))

    return jax.tree.map(mean, states[best], *(states[k] for k in used))


def _copied(learner: Learner, own: Any, parent: Any, copy: str) -> Any:
    if copy == "full":
        new = parent
    elif copy == "weights":
        new = learner.copy_weights(own, parent)
    else:
        new = learner.copy_actor(own, parent)
    return jax.tree.map(jnp.copy, new)  # updates use up their state

"""Members that start again from another: what is copied, and that no two share a buffer."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from pacesetter.algorithms.contract import Learner
from pacesetter.ensemble.rules import Parents


def copy_from_parents(
    learner: Learner, states: Sequence[Any], parents: Parents, copy: str
) -> list[Any]:
    """Each member's new state. A member that is its own parent is unchanged; from another, `full`
    copies the whole state, `weights` leaves a member its own optimiser state, and `actor` copies
    only the parent's actor.
    """
    return [
        own if parent == member else _copied(learner, own, states[parent], copy)
        for member, (own, parent) in enumerate(zip(states, parents, strict=True))
    ]


def _copied(learner: Learner, own: Any, parent: Any, copy: str) -> Any:
    if copy == "full":
        new = parent
    elif copy == "weights":
        new = learner.copy_weights(own, parent)
    else:
        new = learner.copy_actor(own, parent)
    return jax.tree.map(jnp.copy, new)  # updates use up their state

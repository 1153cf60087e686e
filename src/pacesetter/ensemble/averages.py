"""Mean actions that are evaluated: of members, of their EMA actors, and of snapshots.

An EMA actor is a tree of weights beside a member's state that moves a little towards the member's
actor after each of its updates. Nothing here is ever learned from or acts in training.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pacesetter.ensemble.copying import mean_state
from pacesetter.ensemble.rules import Choice
from pacesetter.learner.learners import Learners
from pacesetter.learner.tree_arrays import (
    below,
    flatten,
    policy_tree,
    rebuild,
    rebuilt_policy,
)
from pacesetter.policy import Policy, unstack
from pacesetter.settings.ensemble import Ensemble
from pacesetter.settings.validation import Natural, check
from pacesetter.types import Arrays, Floats


@dataclass
class _Saved:
    """Averages in a checkpoint: who has an EMA actor, and how many snapshots."""

    ema: list[bool]
    snapshots: Natural


class Averages:
    """What a run's mean actions are made of; a run that evaluates none keeps nothing."""

    def __init__(self, run: Ensemble, learners: Learners, like: Policy) -> None:
        """All policies have the shapes of one like it."""
        self.run, self.learners, self.like = run, learners, like
        self.ema: list[Any] = [None] * run.members  # None: no update yet, so as the actor is
        self.snapshots: list[Policy] = []  # the latest last

    def follow(self, k: int) -> None:
        """Move the EMA actor of member k towards its actor, after an update."""
        if not self.run.keeps_ema:
            return
        compiled, state = self.learners.compiled, self.learners.states[k]
        if self.ema[k] is None:
            self.ema[k] = compiled.actors(state)
        else:
            self.ema[k] = compiled.ema_actors(self.ema[k], state, self.run.ema_tau)

    def copy(self, choice: Choice) -> None:
        """Every member takes over its parent's EMA actor, or the mean that its weights give."""
        if choice.weights is None:
            self.ema = [self.ema[parent] for parent in choice.parents]
        elif any(ema is None for ema in self.ema):
            self.ema = [None] * len(self.ema)
        else:
            pairs = zip(choice.weights, choice.parents, strict=True)
            self.ema = [mean_state(self.ema, weights, parent) for weights, parent in pairs]

    def policies(
        self, champion: Policy, members: Sequence[Policy], now: Sequence[Policy]
    ) -> dict[str, list[Policy]]:
        """Policies to average by name; the champion is one of the snapshots.

        `members` are their policies, and `now` the same without regard to any assessment.
        """
        found: dict[str, list[Policy]] = {}
        if len(members) > 1 and self.run.evaluates_means:
            found["members"] = list(members)
        if self.run.keeps_ema:
            pairs = zip(now, self.ema, strict=True)
            found["ema"] = [
                policy if ema is None else replace(policy, actors=unstack(ema))
                for policy, ema in pairs
            ]
        if self.run.snapshots:
            found["snapshots"] = [*self.snapshots, champion][-self.run.snapshots :]
        return found

    def keep_snapshot(self, champion: Policy) -> None:
        """Let the champion of an evaluation that is made join the snapshots."""
        if self.run.snapshots:
            self.snapshots.append(replace(champion, about={}))
            del self.snapshots[: -self.run.snapshots]

    def arrays(self) -> Arrays:
        return flatten(
            {"ema": self.ema, "snapshots": [policy_tree(each) for each in self.snapshots]}
        )

    def table(self) -> dict[str, Any]:
        return {"ema": [ema is not None for ema in self.ema], "snapshots": len(self.snapshots)}

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `arrays` and `table`."""
        saved = check(_Saved, table)
        if len(saved.ema) != len(self.ema):
            raise ValueError(f"EMA actors of {len(saved.ema)} members")
        layers = self.learners.compiled.actors(self.learners.states[0])
        self.ema = [
            rebuild(layers, below(f"ema.{k}", arrays)) if held else None
            for k, held in enumerate(saved.ema)
        ]
        self.snapshots = []
        for i in range(saved.snapshots):
            self.snapshots.append(rebuilt_policy(self.like, below(f"snapshots.{i}", arrays)))


def mean_policy(policies: Sequence[Policy]) -> Policy:
    """One policy that acts by the mean action of some with the same observation statistics."""
    return replace(policies[0], actors=[actor for each in policies for actor in each.actors])


def mean_action(policies: Sequence[Policy]) -> Callable[[Floats], Floats]:
    """Acts by the mean of all policies' actions in [-1, 1]."""
    return lambda observation: np.mean([each.act(observation) for each in policies], axis=0)

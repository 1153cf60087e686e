"""Policies that training episodes assess before they learn on: TD7's policy checkpoints.

While a member is assessed its policy stays fixed and its updates wait. The assessment ends
as soon as one episode returns less than the worst of the kept policy (it is dropped), or
after enough episodes (it is kept, and evaluated from now on). Then the updates are made.
Reference: sfujim/TD7, maybe_train_and_checkpoint.
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from pacesetter.ensemble.rules import Parents
from pacesetter.learner.tree_arrays import below, flatten, policy_tree, rebuilt_policy
from pacesetter.policy import Policy
from pacesetter.settings.validation import Natural, check
from pacesetter.types import Arrays

LONG_AFTER = 750_000  # updates (TD7)
LOWERED_BY = 0.1  # of the best worst return, once, when assessments become longer


@dataclass
class Assessment:
    """One member's."""

    returns: list[float] = field(default_factory=list[float])  # of the policy's episodes so far
    best: float | None = None  # worst return of the kept policy
    long: bool = False  # whether assessments take more than one episode now
    over: bool = False  # whether updates may be made

    def add(self, episode_return: float, long: bool, most: int) -> bool | None:
        """Add an episode: True to keep the policy, False to drop it, None to go on.

        `long` assessments have `most` episodes, others one. TD7 multiplies the best worst return
        by 0.9 at the change, which would raise a negative one; here it always falls by a tenth.
        """
        if long and not self.long:
            self.long = True
            self.best = None if self.best is None else self.best - LOWERED_BY * abs(self.best)
        self.returns.append(episode_return)
        worst, wanted = min(self.returns), most if self.long else 1
        verdict = None
        if self.best is not None and worst < self.best:
            verdict = False
        elif len(self.returns) >= wanted:
            self.best, verdict = worst, True
        if verdict is not None:
            self.returns, self.over = [], True
        return verdict


@dataclass
class _Saved:
    """All assessments in a checkpoint; each list has one entry per member."""

    assessments: list[Assessment]
    kept: list[dict[str, Any] | None]
    verdicts: list[tuple[Natural, bool]]


class PolicyCheckpoints:
    """The assessments of all members and the policies that were kept; `--assess 0` has none."""

    def __init__(self, hyper: Any, members: int, like: Policy) -> None:
        """All policies have the shapes of one like it."""
        self.episodes: int = hyper.assess
        self.long_after: int = LONG_AFTER if hyper.assess_after is None else hyper.assess_after
        self.assessments = [Assessment() for _ in range(members)]
        self.kept: list[Policy | None] = [None] * members
        self.like = like
        self.verdicts: list[list[Any]] = []  # [member, kept] since the last row

    def start_episode(self, k: int) -> None:
        """Member k's updates wait for the end of its episode."""
        self.assessments[k].over = False

    def may_update(self, k: int) -> bool:
        """Whether no assessment of member k holds its updates back."""
        return not self.episodes or self.assessments[k].over

    def end_episode(self, k: int, total: float, updates: int, policy: Policy, step: int) -> None:
        """Keep or drop member k's policy, after so many updates, or assess it further."""
        assessment = self.assessments[k]
        verdict = assessment.add(total, updates >= self.long_after, self.episodes)
        if verdict is not None:
            self.verdicts.append([k, verdict])
        if verdict:
            about = {"kept_at": step, "worst_return": assessment.best}
            self.kept[k] = replace(policy, about=about)

    def skip_episode(self, k: int) -> None:
        """End an assessment without a verdict, as a copy came in the middle of an episode.

        Waiting for a whole episode could last for ever where copies come more often than ends.
        """
        self.assessments[k].returns, self.assessments[k].over = [], True

    def policy(self, k: int) -> Policy | None:
        """The best policy of member k that was kept, if any was."""
        kept = self.kept[k]
        return kept and replace(kept, about=dict(kept.about))

    def copy(self, parents: Parents, averaged: bool) -> None:
        """Every member takes over what was found of its parent's policy; no episode was played by
        a policy that is averaged.
        """
        before = self.assessments
        self.kept = [self.kept[parent] for parent in parents]
        returns = [[] if averaged else list(before[parent].returns) for parent in parents]
        self.assessments = [
            replace(before[parent], returns=returns[k], over=before[k].over)
            for k, parent in enumerate(parents)
        ]

    def training_values(self) -> dict[str, Any]:
        """Verdicts since the last row, if there are any."""
        values = {"assessed": self.verdicts} if self.verdicts else {}
        self.verdicts = []
        return values

    def arrays(self) -> Arrays:
        return flatten([policy and policy_tree(policy) for policy in self.kept])

    def table(self) -> dict[str, Any]:
        return {
            "assessments": [asdict(assessment) for assessment in self.assessments],
            "kept": [policy and policy.about for policy in self.kept],
            "verdicts": self.verdicts,
        }

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `arrays` and `table`."""
        check(_Saved, table)
        if not len(table["assessments"]) == len(table["kept"]) == len(self.kept):
            raise ValueError(f"assessments of {len(table['assessments'])} members")
        self.assessments = [Assessment(**each) for each in table["assessments"]]
        self.verdicts = table["verdicts"]
        for k, about in enumerate(table["kept"]):
            self.kept[k] = None
            if about is not None:
                kept = rebuilt_policy(self.like, below(str(k), arrays))
                self.kept[k] = replace(kept, about=about)

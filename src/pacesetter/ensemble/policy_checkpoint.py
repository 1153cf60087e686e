"""Policies that training episodes assess before they learn on: TD7's checkpoints.

While a member is assessed its policy stays fixed and its updates wait. The assessment ends
as soon as one episode returns less than the worst of the kept policy (it is dropped), or
after enough episodes (it is kept, and evaluated from now on). Then the updates are made.
Reference: sfujim/TD7, maybe_train_and_checkpoint.
"""

from dataclasses import dataclass, field, replace

LOWERED = 0.1  # of the best worst return, once, when assessments become longer


@dataclass
class Assessment:
    """One member's."""

    returns: list[float] = field(default_factory=list[float])  # of the policy's episodes so far
    best: float | None = None  # worst return of the kept policy
    long: bool = False  # whether assessments take more than one episode now
    over: bool = False  # whether updates may be made

    def copy(self) -> "Assessment":
        return replace(self, returns=list(self.returns))

    def add(self, episode_return: float, long: bool, most: int) -> bool | None:
        """Take in an episode: True to keep the policy, False to drop it, None to go on.

        `long` assessments have `most` episodes, others one. TD7 multiplies the best worst return
        by 0.9 at the change, which would raise a negative one; here it always falls by a tenth.
        """
        if long and not self.long:
            self.long = True
            self.best = None if self.best is None else self.best - LOWERED * abs(self.best)
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

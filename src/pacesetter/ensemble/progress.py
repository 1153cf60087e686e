"""All counters of a run: plain numbers for the checkpoint and, as a ledger, for every row."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

from pydantic import Field

from pacesetter.ensemble.rules import Choice
from pacesetter.ensemble.varied import inherited
from pacesetter.errors import TrainingError
from pacesetter.settings.budget import Standing
from pacesetter.settings.validation import Finite, Natural, check
from pacesetter.types import DIVERGED, DIVERGENCE, Arrays, Floats

TRAIN_ROW_EVERY = 1_000  # steps


Ended = Annotated[list[Finite], Field(min_length=3, max_length=3)]  # member, return, length


@dataclass
class Member:
    """One member's counters."""

    steps: Natural = 0
    actions: Natural = 0  # of its steps, those that its learner chose
    update_calls: Natural = 0
    updates_due: Finite = 0.0  # critic updates
    copied: Natural = 0  # step of the run at which it last became another's copy
    ended: bool = False  # whether an episode has ended whose updates are not all made
    scales: dict[str, Finite] = field(default_factory=dict[str, float])  # factors of settings


@dataclass
class Progress:
    """Where a run is."""

    members: list[Member]
    tick: Natural = 0
    # Envs that a tick which the task broke off has still to step.
    acting: list[Natural] = field(default_factory=list[int])
    selection_steps: Natural = 0
    free_steps: Natural = 0  # of selection, those that the budget does not count
    updates: Natural = 0
    transitions: Natural = 0
    episodes: Natural = 0
    champion: Natural = 0
    next_evaluation: Natural = 0
    last_evaluation: int = -1
    next_train: Natural = TRAIN_ROW_EVERY
    best: Finite | None = None
    since_best: Natural = 0  # evaluations
    ended: list[Ended] = field(default_factory=list[Ended])  # since the last row
    losses: dict[str, Finite] = field(default_factory=dict[str, float])  # sums since the last row
    summed: Natural = 0  # how many losses were summed
    wall_seconds: Finite = 0.0
    cpu_seconds: Finite = 0.0

    @classmethod
    def of(cls, members: int, scales: Sequence[dict[str, float]] = ()) -> "Progress":
        """A new run's; `scales` are the members' factors of settings, where they differ."""
        return cls([Member(scales=scales[k] if scales else {}) for k in range(members)])

    @classmethod
    def load(cls, table: dict[str, Any]) -> "Progress":
        """The inverse of `table`. Raises a ValueError that names a counter of the wrong kind."""
        check(cls, table)
        members: Any = [Member(**member) for member in table["members"]]
        return cls(**(table | {"members": members}))

    @property
    def standing(self) -> Standing:
        """How the evaluations stand."""
        return Standing(self.best, self.since_best)

    @property
    def step(self) -> int:
        """Env steps so far, of all members and, where it is counted, of selection."""
        members = sum([member.steps for member in self.members])  # a list is quicker here
        return members + self.selection_steps - self.free_steps

    def arrays(self) -> Arrays:
        return {}

    @property
    def actions(self) -> int:
        """Steps whose action a learner chose."""
        return sum([member.actions for member in self.members])

    def table(self) -> dict[str, Any]:
        return asdict(self)

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `table`, in place."""
        found = Progress.load(table)
        if not found.champion < len(found.members) == len(self.members):
            raise ValueError(f"{len(found.members)} members, champion {found.champion}")
        vars(self).update(vars(found))

    def copy(self, choice: Choice) -> None:
        """Note who became another's copy, and whose settings everyone has now."""
        for k, parent in enumerate(choice.parents):
            if parent != k or choice.weights is not None:
                self.members[k].copied = self.step
        scales = inherited(choice, [member.scales for member in self.members])
        for member, new in zip(self.members, scales, strict=True):
            member.scales = new

    def end_episode(self, member: int, total: float, length: int) -> None:
        """Count an episode of a member, for the next row too."""
        self.episodes += 1
        self.ended.append([member, total, length])

    def begin_updates(self, member: int, updates: int, batch_size: int) -> None:
        """Count updates of a member that fell due and are made now."""
        self.members[member].updates_due -= updates
        self.updates += updates
        self.transitions += updates * batch_size

    def add_losses(self, names: Sequence[str], losses: Floats, member: int) -> None:
        """Add the losses of one update to what the next row averages, if none has diverged."""
        for name, loss in zip(names, losses.tolist(), strict=True):
            if not abs(loss) <= DIVERGED:
                where = f"member {member}, step {self.step}"
                raise TrainingError(f"{where}: {name} is {loss}; {DIVERGENCE}")
            self.losses[name] = self.losses.get(name, 0.0) + loss
        self.summed += 1

    def training_values(self) -> dict[str, Any]:
        """Episodes ended as [member, return, length] and mean losses, since the last row."""
        values: dict[str, Any] = {"episodes_ended": self.ended}
        values |= {name: total / self.summed for name, total in self.losses.items()}
        self.ended, self.losses, self.summed = [], {}, 0
        return values

    def ledger(self) -> dict[str, Any]:
        """What the run has spent."""
        return {
            "member_steps": [member.steps for member in self.members],
            "selection_steps": self.selection_steps,
            "updates": self.updates,
            "transitions": self.transitions,
            "episodes": self.episodes,
            "cpu_seconds": round(self.cpu_seconds, 3),
            "wall_seconds": round(self.wall_seconds, 3),
        }


class Clock:
    """Adds the time that passes to a progress; a resumed run goes on from its checkpoint's sums."""

    def __init__(self) -> None:
        self.last = (time.perf_counter(), time.process_time())

    def tell(self, progress: Progress) -> None:
        now = (time.perf_counter(), time.process_time())
        progress.wall_seconds += now[0] - self.last[0]
        progress.cpu_seconds += now[1] - self.last[1]
        self.last = now

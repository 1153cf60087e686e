"""All counters of a run: plain numbers for the checkpoint and, as a ledger, for every row."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

from pacesetter.ensemble.policy_checkpoint import Assessment

TRAIN_ROW_EVERY = 1_000  # steps


@dataclass
class Member:
    """One member's counters and the episode it is in."""

    steps: int = 0
    actions: int = 0  # of its steps, those that its learner chose
    cycles: int = 0  # calls of `update` it has made
    owed: float = 0.0  # critic updates that have fallen due
    active: bool = True  # False while it waits for the others to end their episodes
    starting: bool = True  # its next tick begins an episode
    started: int = 0  # step of the run at which the episode began
    copied: int = 0  # step of the run at which it last became another's copy
    episode_return: float = 0.0
    episode_length: int = 0
    window: list[float] = field(default_factory=list[float])  # returns since the last selection
    assessment: Assessment = field(default_factory=Assessment)

    @classmethod
    def load(cls, table: dict[str, Any]) -> "Member":
        """The inverse of `asdict`."""
        assessment: Any = Assessment(**table["assessment"])
        return cls(**(table | {"assessment": assessment}))

    def start(self, step: int) -> None:
        """Enter an episode at a step of the run."""
        self.starting, self.active, self.started = False, True, step
        self.episode_return, self.episode_length = 0.0, 0

    def step(self, reward: float) -> None:
        """Count one env step."""
        self.steps += 1
        self.episode_length += 1
        self.episode_return += reward

    def abandon(self) -> None:
        """Forget the episode and begin another."""
        self.starting, self.episode_return, self.episode_length = True, 0.0, 0

    def end(self, counts: bool) -> None:
        """End the episode and wait; its return counts in a selection if it was no warm-up."""
        self.active = False
        if counts:
            self.window.append(self.episode_return)


@dataclass
class Progress:
    """Where a run is."""

    members: list[Member]
    tick: int = 0
    selection_steps: int = 0
    free_steps: int = 0  # of selection, those that the budget does not count
    updates: int = 0
    transitions: int = 0
    episodes: int = 0
    champion: int = 0
    selections: int = 0
    variances: list[float] = field(default_factory=list[float])  # of the last selections
    next_evaluation: int = 0
    last_evaluation: int = -1
    next_selection: int = 0
    next_train: int = TRAIN_ROW_EVERY
    best: float | None = None
    ended: list[list[float]] = field(default_factory=list[list[float]])  # since the last row
    assessed: list[list[Any]] = field(default_factory=list[list[Any]])  # likewise
    losses: list[float] = field(default_factory=list[float])  # sums since the last row
    updated: int = 0  # how many losses were summed
    wall_seconds: float = 0.0
    cpu_seconds: float = 0.0

    @classmethod
    def of(cls, members: int) -> "Progress":
        return cls([Member() for _ in range(members)])

    @classmethod
    def load(cls, table: dict[str, Any]) -> "Progress":
        """The inverse of `asdict`."""
        members: Any = [Member.load(member) for member in table["members"]]
        return cls(**(table | {"members": members}))

    @property
    def step(self) -> int:
        """Env steps so far, of all members and, where it is counted, of selection."""
        members = sum(member.steps for member in self.members)
        return members + self.selection_steps - self.free_steps

    def each(self) -> Iterator[tuple[int, Member]]:
        return enumerate(self.members)

    def table(self) -> dict[str, Any]:
        return asdict(self)

    def note(self, losses: Any) -> None:
        """Add the losses of one cycle to what the next row averages."""
        before = self.losses or [0.0] * len(losses)
        self.losses = [a + b for a, b in zip(before, losses.tolist(), strict=True)]
        self.updated += 1

    def training_values(self, loss_names: list[str]) -> dict[str, Any]:
        """Episodes ended as [member, return, length], policies assessed as [member, kept] if any
        were, and mean losses, all since the last row.
        """
        means = [total / self.updated for total in self.losses]
        values: dict[str, Any] = {"episodes_ended": self.ended}
        values |= dict(zip(loss_names, means, strict=False))  # no losses before the first update
        if self.assessed:
            values["assessed"] = self.assessed
        self.ended, self.assessed, self.losses, self.updated = [], [], [], 0
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

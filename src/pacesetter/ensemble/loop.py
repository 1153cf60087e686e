"""What a trainer and a checkpoint know of the loop they drive, off-policy or on-policy."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from pacesetter.ensemble.progress import Progress
from pacesetter.ensemble.selection import Selection
from pacesetter.learner.learners import Learners
from pacesetter.policy import Policy
from pacesetter.replay.buffer import Replay
from pacesetter.types import Arrays


class Part(Protocol):
    """What saves and restores itself: its arrays by name and a table of plain values."""

    def arrays(self) -> Arrays: ...

    def table(self) -> dict[str, Any]: ...

    def restore(self, table: dict[str, Any], arrays: Arrays) -> str | None:
        """The inverse of both; what a person should know. May raise storage.FAULTS."""
        ...


class Loop(Protocol):
    """Everything that a run trains and trains on."""

    progress: Progress
    learners: Learners
    whole: bool  # whether a checkpoint made now, after a fault of the task, would go on exactly
    budget: int  # env steps in all, of every member and, where it is counted, of selection

    @property
    def replays(self) -> Sequence[Replay]: ...

    @property
    def has_due_updates(self) -> bool:
        """Whether updates are due that did not fit into the last tick."""
        ...

    def open_replays(self, folder: Path) -> None:
        """Make or find the replays' files, before the first tick."""
        ...

    def tick(self) -> Selection | None:
        """The smallest piece of work between two checkpoints; the selection, if it made one."""
        ...

    def policy(self, member: int) -> Policy:
        """What a member is evaluated by."""
        ...

    def averaged(self, champion: Policy) -> dict[str, list[Policy]]:
        """Policies whose mean action is evaluated beside the champion's, by name."""
        ...

    def keep_snapshot(self, champion: Policy) -> None:
        """Let the champion of an evaluation that is made join the snapshots."""
        ...

    def training_values(self) -> dict[str, Any]:
        """How training went since this was last called."""
        ...

    def parts(self) -> dict[str, Part]:
        """All that a checkpoint holds, by name, in the order in which it is restored."""
        ...

    def close(self) -> None:
        """Let go of envs, files and threads."""
        ...


def numbered(name: str, parts: Sequence[Part]) -> dict[str, Part]:
    """Several parts of one kind under their numbers."""
    return {f"{name}.{i}": part for i, part in enumerate(parts)}

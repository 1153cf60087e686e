"""What one update after a rollout learns from: the rollout alone, or all steps so far."""

from pathlib import Path
from typing import Any

import numpy as np

from pacesetter.batch import Layout
from pacesetter.config import Config
from pacesetter.dynamics.fit import FEWEST_ROWS
from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError
from pacesetter.replay.buffer import UNCOMMITTED, Replay
from pacesetter.seeding import Stream
from pacesetter.types import Floats

Data = tuple[Floats, dict[str, Any]]  # rows and the batch's other fields


class LastRollout:
    """The rollout just made, in time order: (T, E, width)."""

    def __init__(self, config: Config, layout: Layout, recipe: Recipe) -> None:
        self.envs, self.layout = config.hyper.parallel_envs, layout
        self.length = config.hyper.rollout_length
        self.replays: list[Replay] = []

    def open(self, path: Path, budget: int) -> None:
        """Nothing lies in a file."""

    def keep(self, rows: Floats) -> None:
        """Nothing outlives its iteration."""

    def data(self, rows: Floats, update: int) -> Data:
        """The data of an update, by its number."""
        return rows.reshape(self.length, self.envs, self.layout.width), {}

    def close(self) -> None:
        """There is nothing to let go of."""


class AllSteps:
    """All steps so far, in a ring of a fixed shape (S, width), and fresh starts of episodes.

    Starts are resets of an env of their own, each seeded by its number, so no state is kept.
    """

    def __init__(self, config: Config, layout: Layout, recipe: Recipe) -> None:
        run, hyper = config.run, config.hyper
        self.layout, self.starts = layout, hyper.starts
        self.capacity = min(hyper.replay_size, run.steps)
        rollout = self.rollout = hyper.parallel_envs * hyper.rollout_length
        if not FEWEST_ROWS <= rollout <= min(UNCOMMITTED, hyper.replay_size):
            raise UsageError(
                f"rollout_length: a rollout of all envs must have {FEWEST_ROWS} to "
                f"{min(UNCOMMITTED, hyper.replay_size)} steps, it has {rollout}"
            )
        self.size = hyper.replay_size
        self.env = Environment(recipe, run.seed, Stream.TRAIN, hyper.parallel_envs)
        self.replays: list[Replay] = []

    def open(self, path: Path, budget: int) -> None:
        """Make or find the ring."""
        self.replays.append(
            Replay(path, self.layout, self.size, budget, rows_per_tick=self.rollout)
        )

    def keep(self, rows: Floats) -> None:
        """Put a rollout into the ring."""
        for row in rows:
            self.replays[0].append(row)

    def data(self, rows: Floats, update: int) -> Data:
        """The data of an update, by its number."""
        ring, first = self.replays[0], update * self.starts
        starts = [self.env.reset(episode) for episode in range(first, first + self.starts)]
        valid = min(len(ring), self.capacity)
        return ring.padded(self.capacity), {"starts": np.stack(starts), "valid": valid}

    def close(self) -> None:
        """Let go of env and file."""
        self.env.close()
        for replay in self.replays:
            replay.close()

"""The env border: Gymnasium tasks in float32 with actions in [-1, 1], checked and seeded."""

import gymnasium

from pacesetter.envs.border import Step
from pacesetter.envs.environment import Environment, Snapshot
from pacesetter.envs.ids import known
from pacesetter.envs.tasks import Recipe

__all__ = ["Environment", "Recipe", "Snapshot", "Step", "known"]

gymnasium.register(
    "pacesetter/Ant111-v4",
    entry_point="pacesetter.envs.ant:make_ant111",
    max_episode_steps=1000,
)

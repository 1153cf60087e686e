"""Ant as papers before 2022 had it, under an id of its own."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from pacesetter.envs.tasks import make_quietly


class PaddedAnt(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Ant as the -v2 papers had it: 27 numbers and 84 contact forces that were always zero."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = Box(-np.inf, np.inf, (111,), np.float64)

    def observation(self, observation: Any) -> Any:
        return np.concatenate([observation, np.zeros(84)])


def make_ant111(**kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Entry point of `pacesetter/Ant111-v4`."""
    return PaddedAnt(make_quietly("Ant-v4", kwargs).unwrapped)

"""Tasks so small that what must be learned from them, or stored, is known beforehand."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

Step = tuple[Any, float, bool, bool, dict[str, Any]]
UNIT = Box(-1, 1, (1,), np.float32)
ANY = Box(-np.inf, np.inf, (1,), np.float32)


class Contextual(gymnasium.Env[Any, Any]):
    """One step; its reward is a number, what was seen, how near the action was, or both last."""

    observation_space = ANY

    def __init__(
        self, reward: str, low: float = -1, high: float = 1, best: float = 0.5, steepness: float = 4
    ) -> None:
        self.action_space = Box(low, high, (1,), np.float32)
        self.reward, self.best, self.steepness = reward, best, steepness
        self.seen = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        varies = self.reward in ("observation", "both")
        self.seen = float(self.np_random.choice([-1, 1])) if varies else 0.0
        return np.array([self.seen], np.float32), {}

    def step(self, action: Any) -> Step:
        best = self.best * self.seen if self.reward == "both" else self.best
        nearness = -self.steepness * float(action[0] - best) ** 2
        reward = {"constant": 1.0, "observation": self.seen}.get(self.reward, nearness)
        return np.array([self.seen], np.float32), reward, True, False, {}


class Corridor(gymnasium.Env[Any, Any]):
    """Observes how many steps it has made (or nothing); ends by a fall, by its own cut, or both."""

    observation_space, action_space = ANY, UNIT

    def __init__(
        self, falls_at: int = 0, cut_at: int = 0, reward: str = "each", blind: bool = False
    ) -> None:
        self.falls_at, self.cut_at, self.reward, self.blind = falls_at, cut_at, reward, blind
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> Step:
        self.steps += 1
        fell, cut = self.steps == self.falls_at, self.steps == self.cut_at
        reward = float(self.reward == "each" or fell)
        return self._observe(), reward, fell, cut, {}

    def _observe(self) -> Any:
        return np.array([0 if self.blind else self.steps], np.float32)


class Echo(gymnasium.Env[Any, Any]):
    """Observes the action that it was given, in its own units, and never ends by itself."""

    def __init__(self, low: list[float], high: list[float]) -> None:
        self.action_space = Box(np.array(low, np.float32), np.array(high, np.float32))
        self.observation_space = Box(-np.inf, np.inf, (len(low),), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape or (), np.float32), {}

    def step(self, action: Any) -> Step:
        return np.array(action, np.float32), 0.0, False, False, {}


class Scripted(gymnasium.Env[Any, Any]):
    """Episode i lasts `length` steps and returns `returns[i]`, repeated, whatever is done in it.

    It observes `mark`, noise, and the action; tests set the attributes of each member's env.
    """

    observation_space = Box(-np.inf, np.inf, (3,), np.float32)
    action_space = UNIT

    def __init__(self) -> None:
        self.returns, self.length, self.mark = [0.0], 10, 0.0
        self.steps, self.episode = 0, -1

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        self.episode += 1
        return self._observe(0.0), {}

    def step(self, action: Any) -> Step:
        self.steps += 1
        over = self.steps == self.length
        reward = self.returns[self.episode % len(self.returns)] if over else 0.0
        return self._observe(float(action[0])), reward, over, False, {}

    def _observe(self, action: float) -> Any:
        return np.array([self.mark, self.np_random.normal(), action], np.float32)


REWARDS = {
    "ConstantReward-v0": "constant",
    "ObservationReward-v0": "observation",
    "ActionReward-v0": "action",
    "BothReward-v0": "both",
}
for _name, _reward in REWARDS.items():
    gymnasium.register(_name, Contextual, kwargs={"reward": _reward})
gymnasium.register("TwoSteps-v0", Corridor, kwargs={"falls_at": 2, "reward": "last"})
gymnasium.register("Corridor-v0", Corridor)
gymnasium.register("Echo-v0", Echo, max_episode_steps=20)
gymnasium.register("Scripted-v0", Scripted)

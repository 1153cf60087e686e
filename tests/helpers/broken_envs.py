"""Tasks that break Gymnasium's rules, each in one way, and one that keeps to them.

They are named `broken_envs:NAME-v0`, as tasks of any other package are.
"""

import os
import sys
import time
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

EPISODE = 100
NAN = float("nan")


class Probe(gymnasium.Env[Any, Any]):
    """Move a point of three numbers with two; bounds are not symmetric, episodes last 100 steps."""

    observation_space: Any = Box(-9, 9, (3,), np.float32)
    action_space: Any = Box(np.float32([-2, 0]), np.float32([1, 4]), dtype=np.float32)

    def __init__(self, gain: float = 1.0, **extra: Any) -> None:
        if extra and type(self) is Probe:
            raise TypeError(f"unknown argument {next(iter(extra))}")
        self.gain = gain
        self.point = np.zeros(3, np.float32)
        self.count = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.point = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        self.count = 0
        return self.point.copy(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        self.count += 1
        self.point[:2] = 0.9 * self.point[:2] + 0.1 * np.tanh(action)
        self.point[2] = self.count / EPISODE
        reward = self.gain * float(1 - self.point[0] ** 2)
        return self.point.copy(), reward, False, self.count >= EPISODE, {}


class WrongShape(Probe):
    def step(self, action: Any) -> Any:
        return np.zeros(4, np.float32), *super().step(action)[1:]


class NanObservation(Probe):
    def step(self, action: Any) -> Any:
        return np.float32([0, NAN, 0]), *super().step(action)[1:]


class NanReset(Probe):
    def reset(self, **options: Any) -> Any:
        return np.full(3, NAN, np.float32), super().reset(**options)[1]


class Reward(Probe):
    """The reward is whatever `reward` is."""

    reward: Any = None

    def step(self, action: Any) -> Any:
        observation, _, *rest = super().step(action)
        return observation, self.reward, *rest


class InfiniteReward(Reward):
    reward = float("inf")


class HugeReward(Reward):
    reward = 1e39


class ArrayReward(Reward):
    reward = np.zeros((40, 3))


class NoReward(Reward):
    reward = None


class FourValues(Probe):
    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, info


class BareReset(Probe):
    def reset(self, **options: Any) -> Any:
        return super().reset(**options)[0]


class TextObservation(Probe):
    def step(self, action: Any) -> Any:
        return np.full((30, 30), "x"), *super().step(action)[1:]


class RaisesInStep(Probe):
    def step(self, action: Any) -> Any:
        raise RuntimeError("the motor is on fire\nand this is a second line")


class RaisesInReset(Probe):
    def reset(self, **options: Any) -> Any:
        raise RuntimeError("no ground to stand on")


class RaisesWhenMade(Probe):
    def __init__(self) -> None:
        raise OSError("no licence file\nsee the manual")


class DiscreteAction(Probe):
    action_space = Discrete(4)


class DictAction(Probe):
    action_space = Dict({"a": Box(-1, 1, (3,))})


class InfiniteBounds(Probe):
    action_space = Box(np.float32([-np.inf, *range(40)]), np.float32([np.inf, *range(1, 41)]))


class IntegerAction(Probe):
    action_space = Box(0, 10, (2,), np.int32)


class NoNumbers(Probe):
    observation_space = Box(-1, 1, (0,))


class NoActions(Probe):
    action_space = Box(-1, 1, (0,))


class NoSpaces(Probe):
    observation_space = None  # type: ignore[assignment]


class RaisesInClose(Probe):
    def close(self) -> None:
        raise RuntimeError("the door is stuck")


class Precise(Probe):
    """Its action bounds are float64, and float32 has only larger and smaller numbers."""

    action_space = Box(np.array([-0.1, -1 / 3]), np.array([0.1, 0.3]), dtype=np.float64)


class Square(Probe):
    """Observes 3 x 2 numbers and takes 1 x 2."""

    observation_space = Box(-9, 9, (3, 2), np.float32)
    action_space = Box(-2, 2, (1, 2), np.float32)

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        return np.zeros((3, 2), np.float32), {}

    def step(self, action: Any) -> Any:
        assert action.shape == (1, 2)
        return np.repeat(action, 3, axis=0), 0.0, False, False, {}


class Endless(Probe):
    def step(self, action: Any) -> Any:
        observation, reward, *_ = super().step(action)
        self.point[2] = 0
        return observation, reward, False, False, {}


class Hangs(Probe):
    """Never comes back from its 150th step, and makes a file there."""

    def __init__(self, mark: str) -> None:
        super().__init__()
        self.mark, self.life = mark, 0

    def step(self, action: Any) -> Any:
        self.life += 1
        if self.life == 150:
            Path(self.mark).touch()
            while True:
                time.sleep(1)
        return super().step(action)


class Ageing(Probe):
    """Pays more in every episode of its life, which no seed and no observation tells."""

    lives: int = 0

    def reset(self, **options: Any) -> Any:
        self.lives += 1
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        observation, _, *rest = super().step(action)
        return observation, float(self.lives), *rest


class Restless(Probe):
    """Does not repeat an episode: its moves are drawn from a source that no seed reaches."""

    source: ClassVar = np.random.default_rng()

    def step(self, action: Any) -> Any:
        self.point[0] += self.source.normal() / 100
        return super().step(action)


class Late(Probe):
    """Fine until the `at`-th step that the instance number `victim` makes in its whole life."""

    fault: ClassVar[str] = ""
    victim: ClassVar[int | None] = None
    at: ClassVar[int] = 0
    made: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        self.number, self.life = Late.made, 0
        Late.made += 1

    @classmethod
    def arm(cls, fault: str, victim: int | None, at: int) -> None:
        """Number instances from 0 again and choose the one that fails, and how."""
        cls.fault, cls.victim, cls.at, cls.made = fault, victim, at, 0

    @classmethod
    def disarm(cls) -> None:
        """No instance fails any more."""
        cls.arm("", None, 0)

    def step(self, action: Any) -> Any:
        self.life += 1
        result = super().step(action)
        return self._fail(result) if (self.number, self.life) == (self.victim, self.at) else result

    def _fail(self, result: Any) -> Any:
        if self.fault == "nan":
            return np.float32([0, 0, NAN]), *result[1:]
        if self.fault == "reward":
            return result[0], float("-inf"), *result[2:]
        if self.fault == "exit":
            sys.exit(0)
        if self.fault == "os._exit":
            os._exit(0)
        if self.fault == "interrupt":
            raise KeyboardInterrupt
        raise RuntimeError("a bolt fell out\nat the left knee")


def _all(kind: type) -> list[type]:
    return [kind] + [below for child in kind.__subclasses__() for below in _all(child)]


def register(module: str) -> None:
    """Register all tasks of a module by the names of their classes."""
    for kind in _all(Probe):
        if kind.__module__ == module:
            gymnasium.register(f"{kind.__name__}-v0", entry_point=f"{module}:{kind.__name__}")


register(__name__)

"""Tasks that keep to the sense of Gymnasium's rules, not to the letter; and some that do neither.

They are named `odd_envs:NAME-v0`. What can be cast is cast; the rest is refused in one line.
"""

from typing import Any, NoReturn

import gymnasium
import numpy as np
from broken_envs import Probe, Reward, register
from gymnasium.spaces import Box, Dict, Discrete, Tuple


class Mute(Exception):  # noqa: N818
    """An exception, and a value, whose text cannot be made."""

    def __str__(self) -> NoReturn:
        raise RuntimeError("no words")

    __repr__ = __str__


class ListObservation(Probe):
    def step(self, action: Any) -> Any:
        return [0.0, 0.0, 0.0], *super().step(action)[1:]


class WideObservation(Probe):
    """float64 in a space of float32, as half of people's own tasks have it."""

    def reset(self, **options: Any) -> Any:
        return super().reset(**options)[0].astype(np.float64), {}

    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        return observation.astype(np.float64), *rest


class OutsideObservation(Probe):
    def reset(self, **options: Any) -> Any:
        return np.float32([0, 0, -10]), super().reset(**options)[1]


class RoundedObservation(Probe):
    """Outside by a rounding, which is worth no word."""

    def reset(self, **options: Any) -> Any:
        return np.float32([0, 0, 9.000001]), super().reset(**options)[1]


class Converted(Probe):
    """Its reward and flags go through `pay` and `flag`."""

    pay: Any = staticmethod(float)
    flag: Any = staticmethod(bool)

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, self.pay(reward), self.flag(terminated), self.flag(truncated), info


class LineReward(Converted):
    pay = staticmethod(lambda reward: np.array([reward]))


class PointReward(Converted):
    pay = staticmethod(np.array)


class BoolReward(Converted):
    pay = staticmethod(lambda reward: np.bool_(reward > 0.5))


class IntFlags(Converted):
    flag = staticmethod(int)


class LineFlags(Converted):
    flag = staticmethod(lambda flag: np.array([flag]))


class TwoInTerminated(Converted):
    flag = staticmethod(lambda flag: 2)


class MuteReward(Reward):
    reward = Mute()


class OddInfo(Probe):
    """Keys that are no strings, beside a reward term."""

    def step(self, action: Any) -> Any:
        *rest, _ = super().step(action)
        return *rest, {0: 1, None: 2, ("reward_", 1): 3, "reward_lean": 0.5, "reward_text": "x"}


class ListInfo(Probe):
    def step(self, action: Any) -> Any:
        *rest, _ = super().step(action)
        return *rest, []


class MuteWhenMade(Probe):
    def __init__(self) -> None:
        raise Mute


class BareAssert(Probe):
    def reset(self, **options: Any) -> Any:
        words = ["sky"]
        assert "ground" in words


class Warm(Probe):
    """A body that stays warm: late in an episode it tells how many came before."""

    heat = 0

    def reset(self, **options: Any) -> Any:
        self.heat += 1
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        if self.count > 80:
            self.point[0] += self.heat / 1000
        return super().step(action)


class Fails(Probe):
    """Its motor burns after some steps of every episode."""

    def step(self, action: Any) -> Any:
        if self.count > 30:
            raise RuntimeError("the motor is on fire")
        return super().step(action)


class Goal(Probe):
    """Observes a Dict, as robots with goals do."""

    observation_space = Dict(place=Box(-9, 9, (2,), np.float32), clock=Box(-1, 1, (1,), np.float32))

    def see(self) -> dict[str, Any]:
        return {"place": self.point[:2].copy(), "clock": self.point[2:].copy()}

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        return self.see(), {}

    def step(self, action: Any) -> Any:
        _, *rest = super().step(action)
        return self.see(), *rest


class Pair(Goal):
    observation_space = Tuple([Box(-9, 9, (2,), np.float32), Discrete(3)])

    def see(self) -> Any:
        return self.point[:2].copy(), 1


class LateDict(Goal):
    """Leaves a part of its observation out."""

    observation_space = Dict({"speed": Box(-9, 9, (2,)), "place": Box(-9, 9, (2,))})

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        return {"speed": np.zeros(2, np.float32), "place": np.zeros(2, np.float32)}, {}


class DiscreteObservation(Probe):
    observation_space = Discrete(3)


class Image(Probe):
    observation_space = Box(0, 255, (8, 8, 3), np.uint8)


class DictOfImage(Probe):
    observation_space = Dict({"a": Tuple([Box(0, 255, (8, 8, 3), np.uint8)])})


class MuteSpace(Probe):
    @property
    def observation_space(self) -> Any:
        raise Mute


def _with_bounds(space: Box, low: Any) -> Box:
    space.low = low
    return space


class WordBounds(Probe):
    observation_space = _with_bounds(Box(-9, 9, (3,), np.float32), np.array(["a", "b", "c"]))


class NoBounds(Probe):
    action_space = _with_bounds(Box(-1, 1, (2,), np.float32), None)


class NarrowBounds(Probe):
    action_space = Box(np.array([-1, 0.1]), np.array([1, 0.1]), dtype=np.float64)


class Doubled(gymnasium.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return 2 * reward


class Raised(gymnasium.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return reward + 1


class MuteWrapper(gymnasium.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: Any) -> None:
        raise Mute


register(__name__)

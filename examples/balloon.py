r"""A balloon that holds its place above a station while it saves power.

It cannot steer: the wind carries it, and only its altitude chooses which wind. Climbing and sinking
cost power, drifting is free. The winds differ from episode to episode.

    PYTHONPATH=examples pacesetter train td3 balloon:Balloon-v0 --steps 20k --warmup 2k \
        --hidden 64 64
    python examples/balloon.py runs/balloon-Balloon-v0/td3/0/policy.safetensors
"""

import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

MINUTE = 60.0  # seconds of a step
STEPS = 200  # of an episode
CEILING = 3.0  # km
CLIMB = 2.0  # m/s at full power
LAG = 120.0  # seconds in which the climb rate follows the power
RADIUS = 2.0  # km from the station at which the reward has fallen to 1 / e
LARGEST = np.array([250.0, 4.0, 2.0, 20.0, 20.0, 20.0])  # that an episode can reach
FORECAST = np.array([0.5, 2.5])  # km, the altitudes whose winds are known


class Balloon(gymnasium.Env[Any, Any]):
    """Observation: distance (km), altitude (km), climb (m/s), winds here, low and high (m/s).

    Action: power in [-1, 1], up or down. Reward: near 1 above the station, less `power_cost` times
    the square of the power. Leaving the air between ground and ceiling ends the task.
    """

    def __init__(self, power_cost: float = 0.3) -> None:
        self.power_cost = power_cost
        self.observation_space = Box(-LARGEST, LARGEST, dtype=np.float64)
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Winds that blow to one side below a calm altitude and to the other above it."""
        super().reset(seed=seed)
        draw = self.np_random.uniform
        self.calm = draw(1.0, 2.0)  # km
        self.shear = draw(3.0, 8.0) * self.np_random.choice([-1.0, 1.0])  # m/s per km
        self.distance, self.altitude, self.climb = draw(-4.0, 4.0), draw(0.8, 2.2), 0.0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One minute."""
        power = float(action[0])
        self.climb += (CLIMB * power - self.climb) * MINUTE / LAG
        self.altitude += self.climb * MINUTE / 1000
        self.distance += self.wind(self.altitude) * MINUTE / 1000
        place = float(np.exp(-((self.distance / RADIUS) ** 2)))
        spent = self.power_cost * power**2
        fallen = not 0 < self.altitude < CEILING
        # Names that begin with reward_ are averaged in every evaluation.
        terms = {"reward_place": place, "reward_power": -spent}
        return self._observation(), place - spent, fallen, False, terms

    def wind(self, altitude: Any) -> Any:
        """Wind (m/s) at an altitude (km)."""
        return self.shear * (altitude - self.calm)

    def _observation(self) -> Any:
        here = (self.distance, self.altitude, self.climb, self.wind(self.altitude))
        return np.array([*here, *self.wind(FORECAST)])


# The step limit is Gymnasium's, so it truncates an episode and does not end the task.
gymnasium.register("Balloon-v0", entry_point=Balloon, max_episode_steps=STEPS)


def pilot(observation: Any) -> Any:
    """A rule made by hand: seek the altitude whose wind leads back in about 20 minutes."""
    distance, altitude, climb, _, low, high = observation
    shear = (high - low) / np.ptp(FORECAST)
    wanted = -distance * 1000 / (20 * MINUTE)
    goal = np.clip(FORECAST[0] + (wanted - low) / shear, 0.3, CEILING - 0.3)
    coasting = climb * LAG / 1000
    return np.clip([(goal - altitude - coasting) / 0.3], -1, 1)


def score(act: Callable[[Any], Any], episodes: int = 100) -> tuple[float, float]:
    """Mean and standard deviation of the returns of episodes that begin in the same ways."""
    env = gymnasium.make("Balloon-v0")
    returns: list[float] = []
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        total, ended = 0.0, False
        while not ended:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total += float(reward)
            ended = terminated or truncated
        returns.append(total)
    return float(np.mean(returns)), float(np.std(returns))


def main(files: list[str]) -> int:
    """Print what chance, rest, the pilot and each given policy file reach."""
    from pacesetter import load

    rng = np.random.default_rng(0)
    who: dict[str, Callable[[Any], Any]] = {
        "random power": lambda observation: rng.uniform(-1, 1, 1),
        "no power": lambda observation: np.zeros(1),
        "pilot": pilot,
    }
    for name, act in (who | {file: load(file) for file in files}).items():
        mean, deviation = score(act)
        print(f"{mean:6.1f} +- {deviation:4.1f}  {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

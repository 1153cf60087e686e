"""Env steps per second of N envs in one process and in several: why `--num-envs` uses a list.

Random actions on HalfCheetah-v5, stepped in turn from a list, by Gymnasium's SyncVectorEnv and by
its AsyncVectorEnv. Rounds alternate; the table has the median of each.
"""

import argparse
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from tabulate import tabulate


def make() -> gymnasium.Env[Any, Any]:
    return gymnasium.make("HalfCheetah-v5")


def plain(count: int, steps: int) -> float:
    """Seconds of a list's steps."""
    envs = [make() for _ in range(count)]
    actions = [env.action_space.sample() for env in envs]
    for env in envs:
        env.reset(seed=0)
    began = perf_counter()
    for _ in range(steps):
        for env, action in zip(envs, actions, strict=True):
            *_, truncated, _ = env.step(action)
            if truncated:
                env.reset()
    return perf_counter() - began


def vector(kind: Callable[[list[Any]], Any]) -> Callable[[int, int], float]:
    """Seconds of a vector env's steps, which resets what has ended by itself."""

    def time(count: int, steps: int) -> float:
        envs = kind([make] * count)
        envs.reset(seed=0)
        actions = np.stack([envs.single_action_space.sample() for _ in range(count)])
        began = perf_counter()
        for _ in range(steps):
            envs.step(actions)
        seconds = perf_counter() - began
        envs.close()
        return seconds

    return time


WAYS = {
    "a list": plain,
    "SyncVectorEnv": vector(SyncVectorEnv),
    "AsyncVectorEnv": vector(AsyncVectorEnv),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=4)
    parser.add_argument("--steps", type=int, default=5_000, help="of each env")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    speeds: dict[str, list[float]] = {name: [] for name in WAYS}
    for _ in range(given.rounds):
        for name, time in WAYS.items():
            speeds[name].append(given.envs * given.steps / time(given.envs, given.steps))
    rows = [(name, round(median(each))) for name, each in speeds.items()]
    print(tabulate(rows, ["way", "env steps per second"], tablefmt="github"))


if __name__ == "__main__":
    main()

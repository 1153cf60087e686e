"""A peer's learning curve beside ours: its own defaults, one core, a line as of results/*.jsonl.

python benchmarks/peers.py sb3-td3 HalfCheetah-v4 --seed 0 --steps 100000 -o results/peers.jsonl

Needs `make .venv/peers`. Evaluations are ten episodes without noise on starts of their own, as
ours; neither their seconds nor those of imports count for a peer.
"""

import argparse
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import gymnasium

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "NPROC", "MKL_NUM_THREADS"), "1")
EPISODES, EVERY = 10, 5_000
PEERS = {
    "sb3-td3": ("stable_baselines3", "TD3"),
    "sb3-sac": ("stable_baselines3", "SAC"),
    "sbx-sac": ("sbx", "SAC"),
    "sbx-tqc": ("sbx", "TQC"),
    "sbx-crossq": ("sbx", "CrossQ"),
}
PACKAGES = {"stable_baselines3": "stable-baselines3", "sbx": "sbx-rl"}


class Curve:
    """Evaluates a learner in `learn` at every so many steps, with clocks that stop meanwhile."""

    def __init__(self, env: str, seed: int) -> None:
        self.env, self.rows = gymnasium.make(env), []
        self.seed, self.next = 10_000 + seed, 0
        self.cpu = self.wall = 0.0
        self.start()

    def start(self) -> None:
        self.began = process_time(), perf_counter()

    def stop(self) -> None:
        self.cpu += process_time() - self.began[0]
        self.wall += perf_counter() - self.began[1]

    def __call__(self, scope: dict[str, Any], _: dict[str, Any]) -> bool:
        if scope["self"].num_timesteps >= self.next:
            self.stop()
            self.add(scope["self"])
            self.next += EVERY
            self.start()
        return True

    def add(self, learner: Any) -> None:
        """One evaluation."""
        returns = [self.episode(learner, number) for number in range(EPISODES)]
        updates, step = int(learner._n_updates), int(learner.num_timesteps)
        spent = (updates, updates * learner.batch_size, round(self.cpu, 3), round(self.wall, 3))
        self.rows.append([step, returns, *spent])
        print(step, round(sum(returns) / EPISODES), round(self.cpu), flush=True)

    def episode(self, learner: Any, number: int) -> float:
        """The return of one episode without noise."""
        observation, _ = self.env.reset(seed=self.seed + number)
        total, over = 0.0, False
        while not over:
            action, _ = learner.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = self.env.step(action)
            total, over = total + float(reward), terminated or truncated
        return round(total, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("env")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    module, name = PEERS[given.peer]
    learner = getattr(__import__(module), name)("MlpPolicy", given.env, seed=given.seed)
    if module == "stable_baselines3":
        import torch

        torch.set_num_threads(1)
    curve = Curve(given.env, given.seed)
    learner.learn(given.steps, callback=curve)
    curve.stop()
    if curve.rows[-1][0] < given.steps:
        curve.add(learner)
    names = (PACKAGES[module], "gymnasium", "mujoco", "numpy", "torch", "jax")
    line = {
        "schema": 1,
        "settings": {
            "algorithm": given.peer,
            "name": given.peer,
            "env": given.env,
            "env_kwargs": {},
            "seed": given.seed,
            "steps": given.steps,
            "members": 1,
            "eval_every": EVERY,
            "eval_episodes": EPISODES,
        },
        "command": f"peers.py {given.peer} {given.env} --seed {given.seed} --steps {given.steps}",
        "versions": {name: version(name) for name in names} | {"python": platform.python_version()},
        "commit": None,
        "threads": 1,
        "machine": f"{platform.machine()}, 1 cores",
        "columns": ["step", "returns", "updates", "transitions", "cpu_seconds", "wall_seconds"],
        "evaluations": curve.rows,
        "selections": [],
    }
    with given.output.open("a") as file:
        file.write(json.dumps(line, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()

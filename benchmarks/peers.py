"""A peer's learning curve beside ours: its own defaults, one core, a line as of results/*.jsonl.

python benchmarks/peers.py sb3-td3 HalfCheetah-v4 --seed 0 --steps 100000 -o results/peers.jsonl

Needs `make .venv/peers`. rl_tools has our networks, since its own are of 64 units, and else its own
defaults; the time of compiling it does not count. Evaluations are ten episodes without noise on
starts of their own, as ours; neither their seconds nor those of imports count for a peer.
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
RL_TOOLS = "rl-tools-td3"
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


class RLTools:
    """rl_tools' TD3 with the names that `Curve` reads of a learner of SB3 or SBX."""

    def __init__(self, env: str, seed: int, steps: int) -> None:
        from gymnasium.wrappers import RescaleAction
        from rltools import TD3

        def task() -> gymnasium.Env[Any, Any]:
            made = RescaleAction(gymnasium.make(env), -1, 1)
            made.reset(seed=seed)
            return made

        self.num_timesteps, self.batch_size = 0, 100
        space: Any = gymnasium.make(env).action_space
        self.low, self.high = space.low, space.high
        name = f"peers_{os.getpid()}"  # compiled below it, and with sizes of the task inside
        networks = {"ACTOR_HIDDEN_DIM": 256, "CRITIC_HIDDEN_DIM": 256}
        self.state = TD3(
            task, enable_evaluation=False, STEP_LIMIT=steps + 1, interface_name=name, **networks
        ).State(seed)

    @property
    def _n_updates(self) -> int:
        """One per step after a warm-up of one batch."""
        return max(self.num_timesteps - self.batch_size, 0)

    def learn(self, steps: int, callback: Curve) -> None:
        while self.num_timesteps < steps:
            callback({"self": self}, {})
            self.state.step()
            self.num_timesteps += 1

    def predict(self, observation: Any, deterministic: bool) -> tuple[Any, None]:
        action = self.state.action(observation.astype("float32"))
        return self.low + (action + 1) / 2 * (self.high - self.low), None


def learner_of(peer: str, env: str, seed: int, steps: int) -> Any:
    """A peer's learner with its defaults, on one thread."""
    if peer == RL_TOOLS:
        return RLTools(env, seed, steps)
    module, name = PEERS[peer]
    learner = getattr(__import__(module), name)("MlpPolicy", env, seed=seed)
    if module == "stable_baselines3":
        import torch

        torch.set_num_threads(1)
    return learner


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("peer", choices=[*PEERS, RL_TOOLS])
    parser.add_argument("env")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    learner = learner_of(given.peer, given.env, given.seed, given.steps)
    curve = Curve(given.env, given.seed)
    learner.learn(given.steps, callback=curve)
    curve.stop()
    if curve.rows[-1][0] < given.steps:
        curve.add(learner)
    own = (
        ("rltools",) if given.peer == RL_TOOLS else (PACKAGES[PEERS[given.peer][0]], "torch", "jax")
    )
    names = (*own, "gymnasium", "mujoco", "numpy")
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

"""Seconds that `pacesetter compare` takes for many runs, which this makes up in a temporary folder.

Each made-up run has the rows of a real one of a million steps: an evaluation every 5,000, a row of
training every 1,000 and two selections every 5,000 in ensembles. CPU seconds count on a busy
machine. Tests make their runs with `make_run` too.

python benchmarks/compare.py
"""

import argparse
import contextlib
import io
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

ENVS = ("HalfCheetah-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5")
ALGORITHMS = {"td3": 1.0, "multi-td3": 0.8, "sac": 1.1, "sunrise": 1.2, "ddpg": 0.4}
BUDGET = 1_000_000
EPISODES = 10


def make_run(
    folder: Path,
    env: str = "HalfCheetah-v5",
    name: str = "td3",
    seed: int = 0,
    *,
    level: float = 5_000.0,
    budget: int = BUDGET,
    evaluations: int = 200,
    planned: int | None = None,
    **settings: Any,
) -> Path:
    """Write a run nobody trained: a rising noisy curve, and selections if it is an ensemble."""
    rng = np.random.default_rng([seed, len(name), len(env), int(level)])
    members = 2 if name.startswith("multi") else 1
    every = budget // evaluations
    run = folder / env.replace("/", "-") / name / str(seed)
    run.mkdir(parents=True)
    config = _config(env, name, seed, members, planned or budget, every, **settings)
    (run / "config.json").write_text(json.dumps(config))
    final = level * (1 + 0.1 * rng.normal())
    rows: list[dict[str, Any]] = []
    for step in range(0, budget + 1, every // 5):
        if step % every == 0:
            rows.append(_evaluation(step, final * (1 - np.exp(-4 * step / budget)), rng, members))
        rows.append({"kind": "train", "step": step, "episodes_ended": [[0, 1.0, 1000]] * 2})
        if members > 1 and step > budget // 20 and step % (every // 2) < every // 5:
            rows.append(_selection(step, rng, members))
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def _config(
    env: str, name: str, seed: int, members: int, steps: int, every: int, **settings: Any
) -> dict[str, Any]:
    run = {"algorithm": "td3", "env": env, "env_kwargs": {}, "name": name, "seed": seed}
    run |= {"steps": steps, "time": None, "members": members, "count": "all", "rule": "best"}
    run |= {"eval_every": every, "eval_episodes": EPISODES, "batch_size": 256}
    return {
        "schema": 1,
        "settings": run | settings,
        "command": f"pacesetter train {name} {env} --seed {seed}",
        "versions": {"pacesetter": "0.1.0", "python": "3.11.7"},
        "commit": "0" * 40,
        "threads": 1,
        "machine": "made up",
    }


def _ledger(step: int, members: int) -> dict[str, Any]:
    return {
        "member_steps": [step // members] * members,
        "selection_steps": 0,
        "updates": max(0, step - 25_000),
        "transitions": 256 * max(0, step - 25_000),
        "episodes": step // 1_000,
        "cpu_seconds": 0.004 * step,
        "wall_seconds": 0.005 * step,
    }


def _evaluation(step: int, value: float, rng: np.random.Generator, members: int) -> dict[str, Any]:
    returns = (value + 100 * rng.normal(size=EPISODES)).tolist()
    row = {"kind": "eval", "step": step, "returns": returns, "lengths": [1000] * EPISODES}
    return row | {"mean": float(np.mean(returns)), "champion": 0} | _ledger(step, members)


def _selection(step: int, rng: np.random.Generator, members: int) -> dict[str, Any]:
    winner = int(rng.integers(members))
    row = {"kind": "select", "step": step, "parents": [winner] * members, "champion": winner}
    gap = {"gap": float(rng.exponential(50)), "standard_error": 60.0}
    return row | gap | _ledger(step, members)


def main() -> None:
    """Make the runs, then compare them in each form."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="runs of each of 20 groups")
    seeds = parser.parse_args().seeds
    with TemporaryDirectory() as name:
        folder = Path(name)
        for env in ENVS:
            for algorithm, level in ALGORITHMS.items():
                for seed in range(seeds):
                    make_run(folder, env, algorithm, seed, level=5_000 * level)
        print(f"{len(ENVS) * len(ALGORITHMS) * seeds} runs of 200 evaluations")
        for output in ([], ["report.html", "--no-film"], ["table.md"], ["curves.pdf"]):
            words = ["-o", str(folder / output[0]), *output[1:]] if output else []
            cpu, wall = _seconds(["compare", str(folder), "--published", *words])
            print(f"{output[0] if output else 'table':12} {cpu:5.2f} CPU s {wall:5.2f} s")


def _seconds(words: list[str]) -> tuple[float, float]:
    """CPU and wall seconds of one command; the first also pays for the imports."""
    cpu, wall = time.process_time(), time.perf_counter()
    from pacesetter.cli.main import main as pacesetter

    with contextlib.redirect_stdout(io.StringIO()):
        code = pacesetter(words)
    if code:
        raise SystemExit(code)
    return time.process_time() - cpu, time.perf_counter() - wall


if __name__ == "__main__":
    main()

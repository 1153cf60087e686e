"""What drawing rows by priority costs: alone, in CPU time, and as a share of a whole run's steps/s.

The first table is one cycle of TD3: 2 x 256 rows drawn from a full replay and their errors fed
back, in microseconds of CPU, without gathering the rows. The second compares runs on a task; each
measurement is a process of its own, and kinds alternate. See --help.
"""

import argparse
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np
from speed import timed_steps
from tabulate import tabulate

Settings = dict[str, Any]
KINDS: dict[str, Settings] = {
    "uniform": {},
    "prioritized": {"replay": "prioritized"},
    "lap": {"replay": "lap"},
    "return": {"replay": "return"},
    "return, weights": {"replay": "return", "replay_importance": 0.4},
    "return to go": {"replay": "return", "replay_to_go": True},
}
SHAPE = (2, 256)
EPISODE = 1_000
START = 2_000  # steps before the clock starts: warm-up, compilation, settling


def time_alone(settings: Settings, rows: int, repeats: int) -> tuple[float, float]:
    """Median CPU microseconds of drawing and of feeding back, from a full ring."""
    from pacesetter.replay.buffer import make_sampler
    from pacesetter.settings import OffPolicy

    rng, sampler = np.random.default_rng(0), make_sampler(OffPolicy(**settings), rows)
    for number in range(rows):
        sampler.add(number, 0, 0.0)
        if number % EPISODE == EPISODE - 1:
            sampler.end(0, rng.normal())
    window = range(rows)
    marks: list[list[float]] = [[], []]
    for _ in range(repeats):
        began = process_time()
        numbers = sampler.sample(rng, SHAPE, window, 0.5).numbers
        drawn = process_time()
        error = rng.exponential(size=SHAPE).astype(np.float32)
        fed = process_time()
        sampler.feedback(numbers, error)
        marks[0].append(drawn - began)
        marks[1].append(process_time() - fed)
    return median(marks[0]) * 1e6, median(marks[1]) * 1e6


def time_run(settings: Settings, env: str, steps: int, seed: int) -> float:
    """Steps/s of a TD3 run between two of its train reports."""
    from pacesetter import Trainer

    quiet: Settings = {"eval_every": 10**9, "eval_episodes": 1, "warmup": 1_000}
    trainer = Trainer("td3", env, runs="runs", steps=1_000_000, seed=seed, **quiet, **settings)
    marks: list[tuple[int, float]] = []
    for report in trainer:
        if report.kind == "train" and report.step >= START:
            marks.append((report.step, perf_counter()))
        if report.step >= START + steps:
            break
    (first, began), (last, ended) = marks[0], marks[-1]
    return (last - first) / (ended - began)


def time_apart(kind: str, env: str, steps: int, seed: int) -> float:
    """`time_run` in a fresh process and folder."""
    task = [kind, env, str(steps), str(seed)]
    command = [sys.executable, str(Path(__file__).resolve()), "--measure", *task]
    with TemporaryDirectory() as folder:
        done = subprocess.run(command, cwd=folder, env=os.environ, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(task)} failed:\n{done.stderr}")
    return float(done.stdout.split()[-1])


def show_alone(rows: int, repeats: int) -> None:
    """Print the first table."""
    lines: list[tuple[str, str, str]] = []
    for kind, settings in KINDS.items():
        drawing, feedback = time_alone(settings, rows, repeats)
        lines.append((kind, f"{drawing:.0f}", f"{feedback:.0f}"))
    print(f"CPU microseconds a cycle of {SHAPE[0]} x {SHAPE[1]} rows of {rows:,}\n")
    print(tabulate(lines, ["replay", "draw", "feedback"], "github", disable_numparse=True))


def show_runs(env: str, steps: int, rounds: int) -> None:
    """Print the second table: medians, and of the ratios to uniform within a round."""
    rates: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for seed in range(rounds):
        for kind in KINDS:
            rates[kind].append(time_apart(kind, env, steps, seed))
    lines: list[tuple[str, str, str]] = []
    for kind, found in rates.items():
        ratios = [a / b for a, b in zip(found, rates["uniform"], strict=True)]
        lines.append((kind, f"{median(found):.0f}", f"{median(ratios):.2f}"))
    print(f"\ntd3 {env}, {steps} steps, {rounds} rounds\n")
    print(tabulate(lines, ["replay", "steps/s", "of uniform"], "github", disable_numparse=True))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Compare the costs of the kinds of replay.")
    parser.add_argument("--rows", type=int, default=1_000_000, help="rows in the replay")
    parser.add_argument("--repeats", type=int, default=1_000, help="cycles drawn alone")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=timed_steps, default=3_000, help="timed steps")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each kind; 0 for none")
    parser.add_argument("--measure", nargs=4, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.measure:
        kind, env, steps, seed = chosen.measure
        print(time_run(KINDS[kind], env, int(steps), int(seed)))
        return
    versions = ", ".join(f"{name} {version(name)}" for name in ("pacesetter", "jax", "numpy"))
    print(f"{versions}; {len(os.sched_getaffinity(0))} cores\n", flush=True)
    show_alone(chosen.rows, chosen.repeats)
    if chosen.rounds:
        show_runs(chosen.env, chosen.steps, chosen.rounds)


if __name__ == "__main__":
    main()

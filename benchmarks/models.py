"""What the learners with a model cost: env steps/s of STEVE, seconds of an iteration of ME-TRPO.

python benchmarks/models.py

A process of its own for each is not needed: they take turns in this one, on an idle machine.
"""

import os
from importlib.metadata import version
from itertools import pairwise
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from pacesetter import Trainer

ENV = "HalfCheetah-v5"
QUIET: dict[str, Any] = {"eval_every": 10**9, "eval_episodes": 1}


def steps_a_second(name: str) -> float:
    """Median over each 1000 steps, past the warm-up and what compiles."""
    with TemporaryDirectory() as runs:
        marks: list[float] = []
        for report in Trainer(name, ENV, runs=runs, warmup=1000, **QUIET):
            if report.kind == "train" and report.step >= 2000:
                marks.append(report.ledger["wall_seconds"])
            if report.step >= 5000:
                break
    return median(1000 / (b - a) for a, b in pairwise(marks))


def seconds_an_iteration(name: str) -> float:
    """Median wall time of an iteration after the first, which compiles; the rollout is in it."""
    with TemporaryDirectory() as runs:
        trainer = Trainer(name, ENV, runs=runs, **QUIET)
        took: list[float] = []
        for _ in range(6):
            before = trainer.progress.wall_seconds
            trainer.loop.tick()
            trainer.save()  # which tells the clock
            took.append(trainer.progress.wall_seconds - before)
        trainer.close()
    return median(took[1:])


def main() -> None:
    """Print both, with their targets."""
    print(f"{ENV}, jax {version('jax')}, {len(os.sched_getaffinity(0))} cores")
    print(f"steve-td3: {steps_a_second('steve-td3'):.0f} env steps/s (target 40)", flush=True)
    print(f"me-trpo: {seconds_an_iteration('me-trpo'):.0f} s an iteration (target 60)", flush=True)


if __name__ == "__main__":
    main()

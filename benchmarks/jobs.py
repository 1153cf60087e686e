"""Whether two runs, each pinned to a core, are faster than one run on both: env steps/s of each.

python benchmarks/jobs.py [--algorithm sac]

A measurement is a process of its own; all ways take turns, on an otherwise idle machine. `bench`
pins its runs to a core each because that was faster.
"""

import argparse
import os
import subprocess
import sys
from importlib.metadata import version
from itertools import pairwise
from statistics import median
from tempfile import TemporaryDirectory

from tabulate import tabulate

START, REPORTED = 2_000, 1_000  # 1000 steps of warm-up, then 1000 that compile and settle


def measure(name: str, env: str, steps: int, seed: int) -> float:
    """Env steps/s of one run, an update a step, between its reports of training."""
    from pacesetter import Trainer

    settings = {"warmup": 1_000, "eval_every": 10**9, "eval_episodes": 1, "seed": seed}
    with TemporaryDirectory() as runs:
        marks: list[tuple[int, float]] = []
        for report in Trainer(name, env, runs=runs, **settings):
            if report.kind == "train" and report.step >= START:
                marks.append((report.step, report.ledger["wall_seconds"]))
            if report.step >= START + steps:
                break
    return median((step - before) / (now - then) for (before, then), (step, now) in pairwise(marks))


def together(name: str, env: str, steps: int, jobs: list[set[int]]) -> float:
    """Summed env steps/s of runs at the same time, each on its own set of cores."""
    words = [sys.executable, __file__, "--algorithm", name, "--env", env, "--steps", str(steps)]
    processes: list[subprocess.Popen[str]] = []
    before = os.sched_getaffinity(0)
    for seed, cores in enumerate(jobs):
        os.sched_setaffinity(0, cores)  # which the process inherits
        environment = {**os.environ, "NPROC": str(len(cores))}
        one = [*words, "--measure", str(seed)]
        processes.append(subprocess.Popen(one, env=environment, stdout=subprocess.PIPE, text=True))
    os.sched_setaffinity(0, before)
    return sum(float(process.communicate()[0]) for process in processes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algorithm", default="td3", help="of one update a step")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=5_000, help="measured steps of each run")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    found = parser.parse_args()
    if found.measure is not None:
        print(measure(found.algorithm, found.env, found.steps, found.measure))
        return
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        sys.exit("needs two cores")
    first, second = cores[:2]
    ways = {
        "two runs, a core each": [{first}, {second}],
        "one run on both": [{first, second}],
        "one run on one": [{first}],
    }
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(found.rounds):
        for name, jobs in ways.items():
            rates[name].append(together(found.algorithm, found.env, found.steps, jobs))
    rows = [
        (name, f"{median(values):.0f}", " ".join(f"{v:.0f}" for v in values))
        for name, values in rates.items()
    ]
    header = (f"{found.algorithm} on {found.env}", "steps/s, median", "each round")
    print(tabulate(rows, header, "github"))
    pinned, both, lone = (median(values) for values in rates.values())
    word = "faster" if pinned > both else "slower"
    print(f"two pinned runs are {word}: {pinned / both:.2f} times the steps/s of one on both cores")
    print(f"two pinned runs / twice one pinned alone = {pinned / (2 * lone):.2f} (target 0.88)")
    print(f"{len(cores)} cores, jax {version('jax')}, medians of {found.rounds} rounds")


if __name__ == "__main__":
    main()

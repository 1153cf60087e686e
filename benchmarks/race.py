"""A race on this machine: env steps/s of one run on all cores, and of one pinned run per core.

python benchmarks/race.py [--who pacesetter SB3] [--what td3] [--rounds 2] [--steps 2000]

One critic update per step, batches of 256, networks of 256 x 256, HalfCheetah-v5, no evaluations.
Two pinned runs are what a study does: their steps/s are added. Every measurement is a process of
its own; entries take turns. rl_tools (`pip install 'rltools[mkl]'`, C++) makes only td3 and uses
one core; it compiles when it starts, which is not timed.
"""

import argparse
import os
import platform
import subprocess
import sys
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, NamedTuple

from speed import OUR_RATES, OURS, START, rate, time_peer, timed_steps
from tabulate import tabulate

ENV = "HalfCheetah-v5"
LEARNERS: dict[str, dict[str, Any]] = {
    "td3": OUR_RATES | {"policy_delay": 2, "exploration_noise": 0.1},
    "sac": OUR_RATES | {"alpha_learning_rate": 3e-4},
    "crossq-small": {"batch_size": 256, "warmup": 1_000},
    "multi-td3": OUR_RATES | {"policy_delay": 2, "exploration_noise": 0.1, "rule": "none"},
}


class Entry(NamedTuple):
    """Who runs what."""

    who: str
    what: str


ENTRIES = (
    *(Entry("pacesetter", what) for what in LEARNERS),
    *(Entry("pacesetter bf16", what) for what in LEARNERS),
    *(Entry(who, what) for who in ("SB3", "SBX") for what in ("td3", "sac")),
    Entry("SBX", "crossq-small"),
    Entry("rl_tools", "td3"),
)


def time_ours(what: str, steps: int, precision: str) -> float:
    """Env steps/s of a Trainer between two of its train reports, counted over all members."""
    from pacesetter import Trainer

    settings = LEARNERS[what] if what == "crossq-small" else OURS | LEARNERS[what]
    quiet = {"eval_every": 10**9, "eval_episodes": 1, "precision": precision}
    marks: list[tuple[int, float]] = []
    for report in Trainer(what, ENV, runs="runs", **settings, **quiet):
        if report.kind == "train" and report.step >= START:
            marks.append((report.step, perf_counter()))
        if report.step >= START + steps:
            break
    return rate(marks)


def time_crossq_of_sbx(steps: int) -> float:
    """SBX's CrossQ with critics as narrow as crossq-small's."""
    from sbx import CrossQ

    marks: list[tuple[int, float]] = []

    def mark(scope: dict[str, Any], _: dict[str, Any]) -> bool:
        step = scope["self"].num_timesteps
        if step in (START, START + steps):
            marks.append((step, perf_counter()))
        return step < START + steps

    net = {"net_arch": {"pi": [256, 256], "qf": [256, 256]}}
    learner = CrossQ("MlpPolicy", ENV, seed=0, learning_starts=1_000, policy_kwargs=net)
    learner.learn(1_000_000, callback=mark)
    return rate(marks)


def time_rl_tools(steps: int) -> float:
    """rl_tools' TD3 at equal networks and batches; a step of its loop is an env step."""
    import gymnasium
    from gymnasium.wrappers import RescaleAction
    from rltools import TD3

    def task(**keywords: Any) -> Any:
        env = RescaleAction(gymnasium.make(ENV, **keywords), -1, 1)
        env.reset(seed=0)
        return env

    learner = TD3(
        task, enable_evaluation=False, STEP_LIMIT=START + steps + 1, N_WARMUP_STEPS=1_000,
        ACTOR_BATCH_SIZE=256, CRITIC_BATCH_SIZE=256, ACTOR_HIDDEN_DIM=256, CRITIC_HIDDEN_DIM=256,
        ACTOR_NUM_LAYERS=3, CRITIC_NUM_LAYERS=3, OPTIMIZER_ALPHA=3e-4, interface_name="race",
    )  # fmt: skip
    state = learner.State(0)
    for _ in range(START):
        state.step()
    began = perf_counter()
    for _ in range(steps):
        state.step()
    return steps / (perf_counter() - began)


def measure(entry: Entry, steps: int) -> float:
    """Env steps/s of one entry in this process."""
    if entry.who == "rl_tools":
        return time_rl_tools(steps)
    if entry == ("SBX", "crossq-small"):
        return time_crossq_of_sbx(steps)
    if entry.who in ("SB3", "SBX"):
        return time_peer(entry.who, entry.what, ENV, steps, 0)
    return time_ours(entry.what, steps, "bf16" if entry.who.endswith("bf16") else "f32")


def together(entry: Entry, steps: int, jobs: list[set[int]]) -> float:
    """Added env steps/s of runs at the same time, each on its own cores."""
    words = [sys.executable, os.path.abspath(__file__), "--steps", str(steps), "--measure", *entry]
    before = os.sched_getaffinity(0)
    with TemporaryDirectory() as folder:
        runs: list[subprocess.Popen[str]] = []
        for i, cores in enumerate(jobs):
            os.sched_setaffinity(0, cores)  # which the process inherits
            place = os.path.join(folder, str(i))
            os.mkdir(place)
            count = str(len(cores))
            threads = {"NPROC": count, "OMP_NUM_THREADS": count, "TMPDIR": place}
            runs.append(
                subprocess.Popen(
                    words, env=os.environ | threads, cwd=place, text=True,
                    stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                )
            )  # fmt: skip
        os.sched_setaffinity(0, before)
        outputs = [run.communicate() for run in runs]
    for run, (_, errors) in zip(runs, outputs, strict=True):
        if run.returncode:
            sys.exit(f"{entry}: {errors[-2000:]}")
    return sum(float(output.split()[-1]) for output, _ in outputs)


def processor() -> str:
    """The CPU's name."""
    with open("/proc/cpuinfo") as lines:
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))


def race(entries: list[Entry], steps: int, rounds: int) -> str:
    """All entries in turn, again and again; medians, and each over pacesetter's in float32."""
    cores = sorted(os.sched_getaffinity(0))
    ways = {"one run, all cores": [set(cores)], "one run per core": [{core} for core in cores]}
    found: dict[tuple[Entry, str], list[float]] = {}
    for _ in range(rounds):
        for entry in entries:
            for way, jobs in ways.items():
                speed = together(entry, steps, jobs)
                found.setdefault((entry, way), []).append(speed)
                print(*entry, way, round(speed), file=sys.stderr, flush=True)
    rows: list[list[str]] = []
    for entry in entries:
        row = [entry.what, entry.who]
        for way in ways:
            own = median(found[entry, way])
            base = found.get((Entry("pacesetter", entry.what), way))
            row += [f"{own:.0f}", f"{median(base) / own:.2f}" if base else "-"]
        rows.append(row)
    heads = [x for way in ways for x in (way, "pacesetter / it")]
    return tabulate(sorted(rows), ["", "", *heads], "github", disable_numparse=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--who", nargs="+", help="of the entries, these libraries only")
    parser.add_argument("--what", nargs="+", choices=LEARNERS, help="these learners only")
    parser.add_argument("--steps", type=timed_steps, default=2_000, help="timed steps")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure:
        print(measure(Entry(*given.measure), given.steps))
        return
    entries = [
        entry for entry in ENTRIES
        if entry.who in (given.who or [entry.who]) and entry.what in (given.what or [entry.what])
    ]  # fmt: skip
    print(
        f"{processor()}, {len(os.sched_getaffinity(0))} cores, python {platform.python_version()}"
    )
    print(race(entries, given.steps, given.rounds))


if __name__ == "__main__":
    main()

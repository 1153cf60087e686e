"""What a run spends beside its updates: outside time, members, checkpoints, memory, start-up.

    python benchmarks/costs.py outside members precision norm checkpoint startup recompiles
    python benchmarks/costs.py memory        15 minutes: a full replay of 1M rows, then 200k updates

Each line names its target. Nothing else should run on the machine meanwhile.
"""

import argparse
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import jax
import numpy as np
from ceiling import SPECS, timed, whole

from pacesetter import Trainer

ENV = "HalfCheetah-v5"
MEGA = 1e6
QUIET: dict[str, Any] = {"eval_every": 10**9, "eval_episodes": 1}
FIRST_STEP = """
from pacesetter import Trainer
trainer = Trainer("td3", "HalfCheetah-v5", runs="runs")
reports = iter(trainer)
next(reports)  # the evaluation at step 0, of ten episodes
trainer.loop.tick()
"""
FIRST_UPDATE = """
from pacesetter import Trainer
trainer = Trainer("td3", "HalfCheetah-v5", runs="runs", warmup=2)
while not trainer.progress.updates:
    trainer.loop.tick()
"""


def outside(folder: str) -> None:
    """Share of a run's time that is spent outside the compiled update, checkpoints included."""
    trainer = Trainer("td3", ENV, runs=folder, steps=10**7, warmup=1000, **QUIET)
    compiled, spent, marks = trainer.loop.learners.compiled, [0.0], []
    update = compiled.update

    def watched(*arguments: Any) -> Any:
        began = perf_counter()
        try:
            return update(*arguments)
        finally:
            spent[0] += perf_counter() - began

    compiled.update = watched
    for report in trainer:
        if report.kind == "train" and report.step >= 2000:
            marks.append((perf_counter(), spent[0]))
        if marks and marks[-1][0] - marks[0][0] > 2.2 * trainer.config.run.checkpoint_every:
            break
    (then, a), (now, b) = marks[0], marks[-1]
    print(f"outside the update: {1 - (b - a) / (now - then):.3f} of a run (target 0.08 at most)")


def members(folder: str) -> None:
    """Member updates/s of K members over those of one, alternating."""
    rates = alternating({k: whole("td3", SPECS[ENV], k) for k in (1, 2, 5, 10)})
    for k, found in rates.items():
        print(
            f"{k} members: {median(found):.0f} member updates/s, "
            f"{over(found, rates[1]):.3f} x one's (target 0.95)"
        )


def precision(folder: str) -> None:
    """Updates/s with products in bfloat16 over those in float32, alternating."""
    for name in ("td3", "sac"):
        kinds = ("f32", "bf16")
        rates = alternating({k: whole(name, SPECS[ENV], 1, precision=k) for k in kinds})
        print(
            f"{name}: {median(rates['bf16']):.0f} updates/s in bf16, "
            f"{over(rates['bf16'], rates['f32']):.2f} x {median(rates['f32']):.0f} in f32"
        )


def norm(folder: str) -> None:
    """Updates/s with layer norm in the critics over those without, alternating."""
    for k in (1, 2):
        kinds = {"without": False, "with": True}
        cycles = {n: whole("td3", SPECS[ENV], k, critic_layer_norm=v) for n, v in kinds.items()}
        rates = alternating(cycles)
        print(
            f"{k} members, layer norm in the critics: {median(rates['with']):.0f} member "
            f"updates/s, {over(rates['with'], rates['without']):.2f} x those without"
        )


def alternating(cycles: dict[Any, Any]) -> dict[Any, list[float]]:
    """Updates/s of calls that take turns, nine times."""
    rates: dict[Any, list[float]] = {case: [] for case in cycles}
    for call, *_ in cycles.values():
        call()
    for _ in range(9):
        for case, (call, _, updates) in cycles.items():
            rates[case].append(updates / timed(call, max(80 // updates, 1)))
    return rates


def over(found: list[float], others: list[float]) -> float:
    """The median ratio of rates that were measured side by side."""
    return median(a / b for a, b in zip(found, others, strict=True))


def checkpoint(folder: str) -> None:
    """Share of a minute that its checkpoint takes, Humanoid, 1M rows in the replay."""
    trainer = Trainer("td3", "Humanoid-v5", runs=folder, steps=10**7, **QUIET)
    (replay,), rng = trainer.loop.replays, np.random.default_rng(0)
    while replay.head < 1_000_000:
        replay.rows[replay.head : replay.head + 25_000] = rng.random(replay.layout.width)
        replay.head += 25_000
        trainer.save()
    took: list[float] = []
    for _ in range(5):
        for number in range(replay.head, replay.head + 12_000):  # more than a minute's steps
            replay.rows[number % replay.slots] = rng.random(replay.layout.width)
        replay.head += 12_000
        began = perf_counter()
        trainer.save()
        took.append(perf_counter() - began)
    trainer.close()
    print(f"checkpoint: {median(took):.2f} s, {median(took) / 60:.4f} of a minute (target 0.01)")


def recompiles(folder: str) -> None:
    """Programs that are compiled after the first round of two members."""
    compiled: list[bool] = []
    rounds = 0

    def listen(event: str, duration: float, **details: Any) -> None:
        if "backend_compile" in event:
            compiled.append(rounds > 0)

    jax.monitoring.register_event_duration_secs_listener(listen)
    small: dict[str, Any] = {"hidden": (8,), "batch_size": 8, "warmup": 1000, "steps": 10_000}
    for report in Trainer("multi-td3", ENV, runs=folder, **QUIET, **small):
        rounds += report.kind == "select"
    print(
        f"compiled after the first round: {sum(compiled)}, {len(compiled) - sum(compiled)} "
        f"before; {rounds} rounds (target 0)"
    )


def memory(folder: str) -> None:
    """Resident memory beyond the rows, replay full, and what 200k updates add to it."""
    trainer = Trainer("td3", ENV, runs=folder, steps=10**7, warmup=1_000_000, **QUIET)
    full = 0.0
    for report in trainer:
        if report.kind == "train" and report.step == 1_002_000:
            full = resident()
            rows = trainer.loop.replays[0].layout.width * 4 * 1_000_000 / MEGA
            print(f"memory: {full - rows:.0f} MB beyond {rows:.0f} MB of rows (target 700)")
        if report.step >= 1_202_000:
            break
    print(f"memory: {resident() - full:+.0f} MB after 200k updates (target: flat)")


def resident() -> float:
    """Resident megabytes of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MEGA


def startup(folder: str) -> None:
    """Seconds of a whole process: help; with a cold and a warm compile cache the first env step,
    after the evaluation before it, and the first update, without."""
    environment = os.environ | {"XDG_CACHE_HOME": folder}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)

    def run(*command: str, name: str) -> float:
        with TemporaryDirectory(dir=folder) as place:
            began = perf_counter()
            subprocess.run(command, env=environment, cwd=place, check=True, capture_output=True)
            took = perf_counter() - began
        print(f"{name} took {took:.2f} s", file=sys.stderr)
        return took

    python = sys.executable
    aid = median(run(python, "-m", "pacesetter", "--help", name="help") for _ in range(3))
    print(f"--help: {aid:.2f} s (target 0.5)")
    for what, program in {"env step": FIRST_STEP, "update": FIRST_UPDATE}.items():
        took: dict[str, list[float]] = {"cold": [], "warm": []}
        for number in range(3):
            environment["XDG_CACHE_HOME"] = f"{folder}/{what}/{number}"
            for cache, times in took.items():
                times.append(run(python, "-c", program, name=cache))
        cold, warm = (median(times) for times in took.values())
        print(f"first {what}: {warm:.2f} s warm (target 4), {cold:.2f} s cold (target 12)")


PARTS = {
    f.__name__: f
    for f in (outside, members, precision, norm, checkpoint, startup, recompiles, memory)
}


def main() -> None:
    """Measure the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="+", choices=PARTS)
    versions = ", ".join(f"{name} {version(name)}" for name in ("pacesetter", "jax", "mujoco"))
    print(f"{versions}; {len(os.sched_getaffinity(0))} cores", flush=True)
    for part in parser.parse_args().parts:
        with TemporaryDirectory() as folder:
            PARTS[part](folder)
        sys.stdout.flush()


if __name__ == "__main__":
    main()

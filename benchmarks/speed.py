"""End-to-end env steps/s of pacesetter and its peers: one update a step, no evaluations.

Every measurement is a process of its own; libraries alternate, so that what else the machine
does hits all of them. That is not enough for torch: when its threads wait for a core that
somebody else holds, SB3 slows down by far more than its share. So what others took is measured,
and a disturbed run says so. OMP_NUM_THREADS=1 in front gives torch one thread.

An ensemble has no peer: its cost is set beside what flops.py counts for it.

Run by `make bench-speed`; see --help for other tasks and lengths.
"""

import argparse
import importlib
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, NamedTuple

from tabulate import tabulate

Settings = dict[str, Any]
Mark = tuple[int, float]
Rates = dict[str, list[float]]
IDLE_FIELDS = (3, 4)  # of /proc/stat: idle and waiting for a disk


class Algorithm(NamedTuple):
    """What to train here and in the peers: settings beyond those below, which all share."""

    ours: Settings
    peer: str | None
    theirs: Settings
    noise: float | None = None
    envs: tuple[str, ...] = ("HalfCheetah-v5",)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Who has it."""
        return ("pacesetter", *PEERS, ALONE) if self.peer else ("pacesetter",)


RATE = 3e-4
OUR_RATES: Settings = {"actor_learning_rate": RATE, "critic_learning_rate": RATE}
OURS: Settings = {"batch_size": 256, "hidden": [256, 256], "updates_per_step": 1, "warmup": 1000}
THEIRS: Settings = {
    "batch_size": 256,
    "policy_kwargs": {"net_arch": [256, 256]},
    "train_freq": 1,
    "gradient_steps": 1,
    "learning_starts": 1000,
    "learning_rate": RATE,
    "device": "cpu",
    "verbose": 0,
}
ALGORITHMS = {
    "td3": Algorithm(
        OUR_RATES | {"policy_delay": 2, "exploration_noise": 0.1},
        "TD3",
        {"policy_delay": 2},
        0.1,
        ("HalfCheetah-v5", "Ant-v5", "Humanoid-v5"),
    ),
    "sac": Algorithm(OUR_RATES | {"alpha_learning_rate": RATE}, "SAC", {"ent_coef": "auto"}),
    "sunrise": Algorithm(OUR_RATES | {"alpha_learning_rate": RATE, "ensemble": 5}, None, {}),
}
PEERS = {"SB3": "stable_baselines3", "SBX": "sbx"}
ALONE = "env alone"
TARGETS = {  # and stretch targets
    ("td3", "HalfCheetah-v5", "SB3"): (4.0, 4.5),
    ("td3", "HalfCheetah-v5", "SBX"): (2.1, 2.4),
    ("sac", "HalfCheetah-v5", "SB3"): (4.0, 4.5),
    ("sac", "HalfCheetah-v5", "SBX"): (1.7, 1.9),
}
SCALED = 0.9  # target, of the speed that operations foretell from HalfCheetah's
PACKAGES = ("pacesetter", "jax", "torch", "stable-baselines3", "sbx-rl", "gymnasium", "mujoco")
START = 2_000  # 1000 steps of warm-up, then 1000 that compile and settle
REPORTED = 1_000  # pacesetter reports its training so often
DISTURBED = 0.1  # cores that others kept busy, from which a ratio is worth nothing
LONG = 1_000_000  # budget of a real run, so that replays have their real size


def time_ours(name: str, env: str, steps: int, seed: int) -> float:
    """Steps/s of a Trainer between two of its train reports."""
    from pacesetter import Trainer

    settings = OURS | ALGORITHMS[name].ours | {"eval_every": 10**9, "eval_episodes": 1}
    # Checkpoints stay on, a minute apart, so that seldom one falls into the timed steps.
    trainer = Trainer(name, env, runs="runs", steps=LONG, seed=seed, **settings)
    marks: list[Mark] = []
    for report in trainer:
        if report.kind == "train" and report.step >= START:
            marks.append((report.step, perf_counter()))
        if report.step >= START + steps:
            break
    return rate(marks)


def time_peer(library: str, name: str, env: str, steps: int, seed: int) -> float:
    """Steps/s of a peer between two calls of its callback, at the same steps as ours."""
    algorithm = ALGORITHMS[name]
    learner = getattr(importlib.import_module(PEERS[library]), str(algorithm.peer))
    settings = THEIRS | algorithm.theirs
    if algorithm.noise is not None:
        settings["action_noise"] = gaussian(env, algorithm.noise)
    marks: list[Mark] = []

    def mark(scope: dict[str, Any], _: dict[str, Any]) -> bool:
        step = scope["self"].num_timesteps
        if step in (START, START + steps):
            marks.append((step, perf_counter()))
        return step < START + steps

    learner("MlpPolicy", env, seed=seed, **settings).learn(LONG, callback=mark)
    return rate(marks)


def gaussian(env: str, deviation: float) -> Any:
    """The peers' exploration noise for a task."""
    import gymnasium
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise

    size = gymnasium.make(env).action_space.shape
    return NormalActionNoise(np.zeros(size), np.full(size, deviation))


def rate(marks: list[Mark]) -> float:
    """Steps/s from the first mark to the last."""
    (first, began), (last, ended) = marks[0], marks[-1]
    return (last - first) / (ended - began)


def time_env(env: str, steps: int, seed: int) -> float:
    """Steps/s of the env with actions of no learner, as training steps it."""
    import numpy as np

    from pacesetter.envs import Environment, Recipe
    from pacesetter.seeding import Stream

    task, rng = Environment(Recipe(env), seed, Stream.TRAIN), np.random.default_rng(seed)
    task.reset()
    began = perf_counter()
    for _ in range(steps):
        if task.step(rng.uniform(-1, 1, task.action_size)).ended:
            task.reset()
    return steps / (perf_counter() - began)


def measure(library: str, name: str, env: str, steps: int, seed: int) -> float:
    """One measurement in this process, in its working directory."""
    if library in PEERS:
        return time_peer(library, name, env, steps, seed)
    if library == ALONE:
        return time_env(env, steps, seed)
    return time_ours(name, env, steps, seed)


def others_seconds() -> float:
    """Core seconds that were spent so far by all but this process's finished children."""
    ticks = [int(x) for x in Path("/proc/stat").read_text().split("\n")[0].split()[1:9]]
    busy = sum(x for i, x in enumerate(ticks) if i not in IDLE_FIELDS) / os.sysconf("SC_CLK_TCK")
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return busy - children.ru_utime - children.ru_stime


def measure_apart(library: str, name: str, env: str, steps: int, seed: int) -> tuple[float, float]:
    """Steps/s in a fresh process and folder, and how many cores others kept busy meanwhile."""
    script = Path(__file__).resolve()
    task = [library, name, env, str(steps), str(seed)]
    command = [sys.executable, str(script), "--measure", *task]
    began, others = perf_counter(), others_seconds()
    with TemporaryDirectory() as folder:
        # The peers' loggers leave folders where TMPDIR points.
        place: Settings = {"cwd": folder, "env": os.environ | {"TMPDIR": folder}}
        done = subprocess.run(command, **place, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(task)} failed:\n{done.stderr}")
    taken = (others_seconds() - others) / (perf_counter() - began)
    return float(done.stdout.split()[-1]), taken


def measure_all(name: str, env: str, steps: int, repeats: int) -> tuple[Rates, float]:
    """All libraries in turn, again and again; and the most cores that others kept busy."""
    libraries = ALGORITHMS[name].libraries
    rates: Rates = {library: [] for library in libraries}
    most = 0.0
    for seed in range(repeats):
        for library in libraries:
            found, taken = measure_apart(library, name, env, steps, seed)
            rates[library].append(found)
            most = max(most, taken)
            line = f"{name} {env} {library} round {seed + 1}/{repeats}: {found:.0f} steps/s"
            print(f"{line}, others used {taken:.2f} cores", file=sys.stderr, flush=True)
    return rates, most


def table(rates: Rates) -> str:
    """Median and range by library."""
    rows = [(x, f"{median(r):.0f}", f"{min(r):.0f}-{max(r):.0f}") for x, r in rates.items()]
    return tabulate(rows, ["library", "median steps/s", "min-max"], "github", disable_numparse=True)


def ratio_line(name: str, env: str, peer: str, rates: Rates) -> str:
    """How many times faster than a peer: the median over rounds, which share the weather."""
    ratios = [ours / theirs for ours, theirs in zip(rates["pacesetter"], rates[peer], strict=True)]
    target = TARGETS.get((name, env, peer))
    aim = "" if target is None else "; target {}, stretch {}".format(*target)
    label = f"{name} {env}: pacesetter / {peer} {ALGORITHMS[name].peer}"
    return f"{label} = {median(ratios):.2f} (median of {len(ratios)} pairwise ratios{aim})"


def cost_line(name: str, env: str, base: str, rate: float, base_rate: float) -> str:
    """How much a step costs of another learner's, by the clock and by its operations."""
    import flops

    spec = flops.spec_of(env)
    ours, theirs = (flops.megaflops(x, spec, **ALGORITHMS[x].ours) for x in (name, base))
    return (
        f"{name} {env}: a step takes {base_rate / rate:.1f} times that of {base} "
        f"(ratio of medians; learning takes {ours / theirs:.1f} times the operations)"
    )


def scaled_line(name: str, env: str, rates: Rates, base: str, base_rates: Rates) -> str:
    """Our speed over what HalfCheetah's foretells: its time outside the env grows as the FLOPs."""
    import flops

    mine, theirs = (
        flops.megaflops(name, flops.spec_of(x), **ALGORITHMS[name].ours) for x in (env, base)
    )
    ratios = []
    for ours, alone, base_ours, base_alone in zip(
        rates["pacesetter"], rates[ALONE], base_rates["pacesetter"], base_rates[ALONE], strict=True
    ):
        foretold = (1 / base_ours - 1 / base_alone) * mine / theirs + 1 / alone
        ratios.append(ours * foretold)
    return (
        f"{name} {env}: pacesetter / what {base} foretells = {median(ratios):.2f} "
        f"({mine / theirs:.2f} times the operations; target {SCALED})"
    )


def machine() -> str:
    """Versions, cores and torch's threads."""
    import torch

    versions = [f"{package} {version(package)}" for package in PACKAGES]
    cores, threads = len(os.sched_getaffinity(0)), torch.get_num_threads()
    python = f"python {platform.python_version()}"
    return f"{', '.join(versions)}, {python}; {cores} cores, {threads} torch threads"


def report(name: str, env: str, rates: Rates, taken: float) -> None:
    """Print the table and the ratios of a task, and whether they are worth anything."""
    print(f"\n{name} {env}\n\n{table(rates)}\n")
    for peer in (x for x in rates if x in PEERS):
        print(ratio_line(name, env, peer, rates))
    if taken > DISTURBED:
        print(f"DISTURBED, not a result: others kept up to {taken:.2f} cores busy meanwhile")
    sys.stdout.flush()


def timed_steps(text: str) -> int:
    """A number of steps at which pacesetter reports."""
    steps = int(text)
    if steps < REPORTED or steps % REPORTED:
        raise argparse.ArgumentTypeError(f"must be a multiple of {REPORTED}")
    return steps


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Compare training speed with SB3 and SBX.")
    parser.add_argument("--algorithm", nargs="+", choices=ALGORITHMS, default=[*ALGORITHMS])
    parser.add_argument("--env", nargs="+", help="default: an algorithm's own")
    parser.add_argument("--steps", type=timed_steps, default=3_000, help="timed steps")
    parser.add_argument("--repeats", type=int, default=3, help="rounds over all libraries")
    parser.add_argument("--measure", nargs=5, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Measure, then print versions, and a table and ratios for each task."""
    chosen = options()
    if chosen.measure:
        library, name, env, steps, seed = chosen.measure
        print(measure(library, name, env, int(steps), int(seed)))
        return
    print(f"{machine()}; {chosen.steps} timed steps, {chosen.repeats} rounds", flush=True)
    found: dict[tuple[str, str], Rates] = {}
    for name in chosen.algorithm:
        for env in chosen.env or ALGORITHMS[name].envs:
            rates, taken = measure_all(name, env, chosen.steps, chosen.repeats)
            report(name, env, rates, taken)
            found[name, env] = rates
            for line in beside(name, env, found):
                print(line, flush=True)


def beside(name: str, env: str, found: dict[tuple[str, str], Rates]) -> Iterator[str]:
    """What was measured set beside other learners, for an ensemble, or other tasks."""
    rates = found[name, env]
    for (base, task), others in found.items():
        if task == env and ALGORITHMS[name].peer is None and ALGORITHMS[base].peer:
            ours, theirs = (median(x["pacesetter"]) for x in (rates, others))
            yield cost_line(name, env, base, ours, theirs)
        if base == name and task != env and task == "HalfCheetah-v5" and ALONE in rates:
            yield scaled_line(name, env, rates, task, others)


if __name__ == "__main__":
    main()

"""Experiment: stopped and killed at random points and taken up again, a run ends bit for bit alike.

Of every algorithm, on four tasks, against the same run that nobody disturbed.
"""

import json
import random
import signal
import subprocess
import sys
from contextlib import ExitStack, redirect_stdout
from io import StringIO
from pathlib import Path

import jax
from attempts import Tally, patched
from short_runs import assert_same
from stopping import PATIENCE, RING, litter, only_run

from pacesetter import algorithms, storage
from pacesetter.cli.listing import algorithms as listed
from pacesetter.cli.main import main
from pacesetter.config import resolve
from pacesetter.process import CODES
from pacesetter.replay import buffer
from pacesetter.runs import RunDirectory
from pacesetter.settings import ModelDriven, OffPolicy, OnPolicy

PROGRAM = Path(__file__).with_name("disturbed.py")
POINTS = 10  # of one run
TOGETHER = 5  # of them in one process, the last of which is a SIGKILL, the others SIGTERM
DELAY = 0.02  # seconds after the tick at most
N_STEP = "with 3 steps a row"
TASKS = ("Pendulum-v1", "HalfCheetah-v5", "Hopper-v5", f"Walker2d-v5 {N_STEP}")
EVERY = "--steps 3000 --hidden 16 16 --eval-every 1500 --eval-episodes 1 --checkpoint-every 0.2s -q"
OFF_POLICY = "--batch-size 16 --warmup 200 --replay-size 300"
ON_POLICY = "--rollout-length 50 --parallel-envs 2"
MODEL_DRIVEN = "--steps 3500 --rollout-length 250"  # more iterations than points
MODELS = "--model-hidden 8 --head-hidden 8 --critic-members 2"
OWN = {
    "crossq": "--critic-hidden 16 16 --renorm-after 100",
    "sunrise": "--ensemble 3",
    "sunrise-td3": "--ensemble 3",
    "steve": MODELS,
    "steve-td3": MODELS,
    "me-trpo": "--models 2 --model-hidden 8 --model-batch-size 100 --model-rows 500 --horizon 20 "
    "--model-patience 1 --imagined-steps 100 --policy-updates 2 --critic-epochs 1",
}


def run(folder: Path, count: int, seed: int = 0, points: int = POINTS) -> Tally:
    """So many pairs of an algorithm and a task; with the number of algorithms, each comes once."""
    rng, tally = random.Random(seed), Tally()
    names = [row["name"] for row in listed()]
    for number in range(count):
        turn, place = divmod(number, len(names))
        name, task = names[place], TASKS[(place + turn) % len(TASKS)]
        try:
            _pair(folder / str(number), _words(name, task), points, rng)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            tally.wrong.append(f"{name} on {task}: {error!s:.300}")
        tally.made += points
        tally.values["pairs"] = number + 1
        jax.clear_caches()
    return tally


def told(tally: Tally) -> str:
    """As the table tells it."""
    pairs = f"{tally.values['pairs']} of {len(listed()) * len(TASKS)} pairs of algorithm and task"
    return f"{tally.made:,} points in {pairs}; {len(tally.wrong)} that differ or fail"


def _words(name: str, task: str) -> list[str]:
    """A short run of tiny networks."""
    base = name.removeprefix("multi-")
    hyper = algorithms.find(base).Hyper
    words = ["train", name, task.split()[0], *EVERY.split(), *OWN.get(base, "").split()]
    words += _data(hyper).split()
    if N_STEP in task and issubclass(hyper, OffPolicy) and "steve" not in base:
        words += ["--n-step", "3"]
    if base == "me-trpo" and task == "Pendulum-v1":  # whose reward it must learn
        words.append("--no-known")
    return words


def _data(hyper: type) -> str:
    if issubclass(hyper, OnPolicy):
        return MODEL_DRIVEN if issubclass(hyper, ModelDriven) else ON_POLICY
    return OFF_POLICY


def _pair(folder: Path, words: list[str], points: int, rng: random.Random) -> None:
    with ExitStack() as stack:
        for name, value in RING.items():
            stack.enter_context(patched(buffer, name, value))
        stack.enter_context(redirect_stdout(StringIO()))
        assert main([*words, "--runs", str(folder / "whole")]) == 0
        whole = only_run(folder / "whole")
        last = storage.read(whole.state_file, "checkpoint").table["progress"]["tick"]
        ticks = sorted(rng.sample(range(1, last * 9 // 10), points))
        disturbed = _disturb(words, folder / "disturbed", ticks, rng)
        assert main(["resume", str(disturbed.path), "-q"]) == 0
    assert litter(disturbed) == []
    assert_same(whole, disturbed)


def _disturb(words: list[str], runs: Path, ticks: list[int], rng: random.Random) -> RunDirectory:
    """Some points in each process, which resumes the run after each SIGTERM, and dies at last."""
    found = RunDirectory.of(runs, resolve(words[1], words[2]))
    begin, again = [*words, "--runs", str(runs)], ["resume", str(found.path), "-q"]
    for start in range(0, len(ticks), TOGETHER):
        part = ticks[start : start + TOGETHER]
        signals = [signal.SIGTERM] * (len(part) - 1) + [signal.SIGKILL]
        plan = [
            (begin if tick == ticks[0] else again, sent, tick, rng.uniform(0, DELAY))
            for tick, sent in zip(part, signals, strict=True)
        ]
        ended = subprocess.run(
            [sys.executable, str(PROGRAM), json.dumps(plan)],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        saved = ended.stdout.count(f"ended with {CODES[signal.SIGTERM]}")
        assert (saved, ended.returncode) == (len(part) - 1, -signal.SIGKILL), ended
        assert ended.stderr == "", ended.stderr
    return found

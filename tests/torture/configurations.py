"""Experiment: command lines and suites made at random, which are taken or refused in one line."""

import random
from pathlib import Path

from attempts import Tally, attempt, command, patched, trap
from mutations import WORDS
from odd_files import PROBE, no_further

from pacesetter import algorithms
from pacesetter.config import Run
from pacesetter.settings.validation import fields_of
from pacesetter.training import trainer

PLAIN = ["1", "2", "0.5", "0.99", "10k", "1M", "1e6", "2h", "30s", "best", "uniform", "lap"]
VALUES = [word for word in [*WORDS, *PLAIN] if "\0" not in word and len(word) < 1000]
OTHERS = [word for word in VALUES if "intruder" not in word]  # what is named here is imported
VALUES += ["-0", "+1", " 1", "1e309", "[1,2]", "{}", "NaN", "true", "ａ", "1/2"]  # noqa: RUF001


def words_of(rng: random.Random, runs: Path) -> list[str]:
    """One `train`, with some flags of any value, after an algorithm and a task that are mostly."""
    name = rng.choice([*algorithms.TABLE, "multi-td3", "multi-sac"])
    env = PROBE if rng.random() < 0.9 else rng.choice(OTHERS)
    known = [*fields_of(Run), *fields_of(algorithms.find(name.removeprefix("multi-")).Hyper)]
    words = ["train", name if rng.random() < 0.95 else rng.choice(OTHERS), env]
    for _ in range(rng.randrange(5)):
        flag = f"--{rng.choice(known).replace('_', '-')}"
        if rng.random() < 0.05:
            flag = rng.choice(["--env.gain", "--no-wait", "--env.", "--config", "--stepz"])
        value = rng.choice(PLAIN if rng.random() < 0.5 else VALUES)
        words += [f"{flag}={value}" if rng.random() < 0.7 else flag]
    return [*words, f"--runs={runs}"]


def run(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many command lines; nothing is written and nothing trained."""
    rng = random.Random(seed)
    runs = folder / "runs"
    command("train", "td3", PROBE, "--help")()  # what is imported once is not their time
    tally = Tally()
    with trap(folder), patched(trainer, "prepare", no_further):
        for number in range(count):
            words = words_of(rng, runs)
            attempt(tally, f"configuration {number}: {words!r:.200}", command(*words))
    if runs.exists():
        tally.wrong.append("a refused configuration left files")
    return tally

"""`--randomize`: each training episode has keywords of its own, and evaluations have not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import TINY, assert_same, log, run_to_end, run_to_step

from pacesetter.config import resolve
from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError
from pacesetter.seeding import Stream
from pacesetter.training.trainer import Trainer

TASK = "broken_envs:Probe-v0"  # whose `gain` multiplies the reward
RUN: dict[str, Any] = {**TINY, "steps": 600, "warmup": 100, "eval_every": 200}
RANGES = {"gain": (2.0, 4.0)}


def gains(episodes: list[int], seed: int = 0, index: int = 0) -> list[float]:
    world = Environment(Recipe(TASK), seed, Stream.TRAIN, index, RANGES)
    found: list[float] = []
    for episode in episodes:
        world.reset(episode)
        found.append(world.env.unwrapped.gain)  # pyright: ignore[reportAttributeAccessIssue]
    return found


def test_every_episode_has_its_own_and_the_same_again() -> None:
    drawn = gains([*range(200)])
    assert len(set(drawn)) == 200
    assert (min(drawn) >= 2, max(drawn) <= 4) == (True, True)
    assert np.mean(drawn) == pytest.approx(3, abs=0.15)  # four standard errors
    assert gains([7, 3]) == [drawn[7], drawn[3]]
    assert not {*drawn} & {*gains([*range(20)], seed=1), *gains([*range(20)], index=1)}


@pytest.mark.parametrize("algorithm", ["multi-td3", "trpo"])
def test_training_is_randomised_and_evaluation_is_not(algorithm: str, runs: Path) -> None:
    more = {"hidden": (8,), "warmup": 100, "batch_size": 16}
    if algorithm == "trpo":
        more = {"parallel_envs": 2, "rollout_length": 100}
    settings: dict[str, Any] = {"steps": 600, "eval_every": 600, "eval_episodes": 1, **more}
    plain, drawn = (
        Trainer(algorithm, TASK, runs=runs, name=name, randomize=ranges, **settings)
        for name, ranges in (("plain", {}), ("drawn", RANGES))
    )
    rows = [log(run_to_end(trainer)) for trainer in (plain, drawn)]
    untrained = [next(row["mean"] for row in each if row["kind"] == "eval") for each in rows]
    assert untrained[0] == untrained[1]
    ended = [
        [total for row in each if row["kind"] == "train" for _, total, _ in row["episodes_ended"]]
        for each in rows
    ]
    assert min(ended[1]) > max(ended[0])


def test_a_stopped_run_resumes_exactly(runs: Path) -> None:
    settings: dict[str, Any] = {**RUN, "randomize": RANGES}
    whole = run_to_end(Trainer("td3", TASK, runs=runs, name="whole", **settings))
    stopped = Trainer("td3", TASK, runs=runs, name="part", **settings)
    run_to_step(stopped, 350)
    part = run_to_end(Trainer.resume(stopped.directory.path, allow=[TASK]))
    assert_same(whole, part)


@pytest.mark.parametrize(
    ("randomize", "line"),
    [
        (["gain=2"], r"^randomize: gain needs its lowest and its highest value, as gain=0.8,1.2"),
        (["gain=4,2"], r"^randomize: gain needs its lowest and its highest"),
        ({"gain": 2}, r"^randomize: gain needs its lowest and its highest value"),
        (["gain=2,x"], r"^randomize: should be a valid number"),
        (["gain"], r"^randomize: must be NAME=VALUE,VALUE"),
        (["zzz=1,2"], r"^env: .*unknown argument zzz"),
    ],
)
def test_what_cannot_be_drawn_is_refused(randomize: Any, line: str, runs: Path) -> None:
    with pytest.raises(UsageError, match=line):
        Trainer("td3", TASK, runs=runs, randomize=randomize, **RUN)
    assert not runs.exists()


def test_a_known_reward_is_of_one_task() -> None:
    settings = {"randomize": ["ctrl_cost_weight=0.1,0.2"], "steps": 3000}
    with pytest.raises(UsageError, match=r"^randomize: .*give --no-known$"):
        resolve("me-trpo", "HalfCheetah-v4", settings)
    assert resolve("me-trpo", "HalfCheetah-v4", {**settings, "known": False}).run.randomize

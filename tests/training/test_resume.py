"""A run that is stopped and resumed equals the run that never stopped, bit for bit."""

import gc
import math
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import TINY, assert_same, run_to_end
from stopping import stop_at

from pacesetter import storage
from pacesetter.errors import UsageError
from pacesetter.replay import buffer
from pacesetter.training.trainer import Trainer

MODELS = {"model_hidden": (8,), "head_hidden": (8,), "critic_members": 2}
CASES = {
    "td3": {"env": "HalfCheetah-v5"},
    "multi-td3": {"env": "HalfCheetah-v5", "steps": 3_300, "snapshots": 2},
    "multi-ant": {"env": "Ant-v5", "algorithm": "multi-td3", "members": 3},
    "wrapped": {"env": "Hopper-v5", "algorithm": "multi-td3", "replay_size": 300},
    "ou": {"env": "Hopper-v5", "algorithm": "ddpg", "exploration": "ou", "members": 2},
    "normalized": {"env": "Walker2d-v5", "algorithm": "multi-td3", "normalize_observation": True},
    "trials": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "select_on": "eval",
        "select_every": 500,
    },
    "async": {"env": "Hopper-v5", "algorithm": "multi-td3", "wait": False, "rule": "tournament"},
    "episodes": {"env": "Hopper-v5", "algorithm": "td3-paper", "hidden": (16, 16)},
    "varied": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "members": 4,
        "rule": "pbt",
        "select_window": 2,
        "vary": {"gamma": (0.98, 0.99), "exploration_noise": (0.1, 0.3)},
    },
    "sac": {"env": "Hopper-v5", "algorithm": "multi-sac"},
    "envs": {"env": "Hopper-v5", "algorithm": "sac", "num_envs": 3, "n_step": 3, "lr_end": 0.1},
    "envs-of-members": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "num_envs": 2,
        "replay": "return",
        "update_every": 5,
        "normalize_reward": True,
    },
    "parameter": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "exploration": "parameter",
        "actor_layer_norm": True,
        "copy": "actor",
    },
    "quantiles": {"env": "Hopper-v5", "algorithm": "multi-sac", "quantiles": 5},
    "crossq": {
        "env": "Hopper-v5",
        "algorithm": "multi-crossq",
        "critic_hidden": (16, 16),
        "renorm_after": 100,
    },
    "bins": {
        "env": "Hopper-v5",
        "algorithm": "multi-crossq",
        "critic_hidden": (16, 16),
        "bins": 11,
        "members": 2,
    },
    "sunrise": {"env": "Hopper-v5", "algorithm": "sunrise", "ensemble": 3},
    "one-of-sunrise": {  # its random learner of an episode, and blocks of updates
        "env": "Hopper-v5",
        "algorithm": "multi-sunrise-td3",
        "ensemble": 3,
        "reference": "official",
        "ucb": 0,
        "update_every": 50,
    },
    "prioritized": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "replay": "prioritized",
        "replay_size": 300,
    },
    "lap": {
        "env": "Hopper-v5",
        "algorithm": "multi-sac",
        "replay": "lap",
        "n_step": 3,
        "replay_scope": "member",
    },
    "return": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "replay": "return",
        "replay_size": 300,
        "n_step": 4,
    },
    "to-go": {
        "env": "Hopper-v5",
        "replay": "return",
        "replay_to_go": True,
        "replay_importance": 0.5,
        "replay_size": 400,
    },
    "assessed": {
        "env": "Hopper-v5",
        "algorithm": "multi-td3",
        "assess": 3,
        "assess_after": 200,
        "normalize_observation": True,
    },
    "steve": {"env": "Hopper-v5", "algorithm": "multi-steve", "copy": "weights", **MODELS},
    "steve-td3": {"env": "Hopper-v5", "algorithm": "multi-steve-td3", **MODELS},
    "own-replays": {"env": "Hopper-v5", "algorithm": "multi-td3", "replay_scope": "member"},
    "bf16": {"env": "Hopper-v5", "precision": "bf16", "hidden": (64, 64), "batch_size": 64},
}


def start(case: str, runs: Path, name: str) -> Trainer:
    settings = {**TINY, "steps": 1_500, "algorithm": "td3", "name": name, **CASES[case]}
    return Trainer(settings.pop("algorithm"), settings.pop("env"), runs=runs, **settings)


def test_killed_before_the_first_checkpoint(runs: Path) -> None:
    """Nothing is lost: the run starts again, and says so."""
    whole = run_to_end(start("own-replays", runs, "whole"))
    begun = start("own-replays", runs, "begun")
    begun.close()
    begun.directory.state_file.unlink()
    resumed = Trainer.resume(begun.directory.path)
    assert resumed.notes == ["no checkpoint yet, starting from the beginning"]
    assert_same(whole, run_to_end(resumed))


SLOW = ("normalized", "sac", "ou", "own-replays", "quantiles", "crossq")
SLOW += ("bins", "sunrise", "one-of-sunrise", "lap", "to-go", "assessed")
SLOW += ("bf16", "steve", "steve-td3", "parameter", "trials", "episodes", "return", "async")


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=pytest.mark.slow if c in SLOW else ()) for c in CASES]
)
def test_stopped_anywhere_equals_uninterrupted(
    case: str, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Small blocks, so that the ring of the `wrapped` case really goes round several times.
    monkeypatch.setattr(buffer, "BLOCK", 64)
    monkeypatch.setattr(buffer, "UNCOMMITTED", 150)
    monkeypatch.setattr(buffer, "SLACK", 2 * (150 + 3) + 64)
    whole = run_to_end(start(case, runs, "whole"))
    stopped = start(case, runs, "stopped")
    ticks = np.sort(np.random.default_rng(len(case)).choice(450, size=2, replace=False))
    for tick in ticks:
        stop_at(stopped, int(tick))
        assert not stopped.finished
        stopped = Trainer.resume(stopped.directory.path)
        assert stopped.notes == []
    assert_same(whole, run_to_end(stopped))


def test_checkpoint_of_an_earlier_version_is_refused_in_one_line(runs: Path) -> None:
    """It says which version made it and what to do, and leaves the file as it is."""
    directory = run_to_end(start("td3", runs, "older"))
    for file in (directory.state_file, directory.previous_file):
        arrays, table = storage.read(file, "checkpoint")
        storage.write(file, "checkpoint", storage.Content(arrays, table | {"schema": 3}))
    before = directory.state_file.read_bytes()
    with pytest.raises(UsageError, match=r"schema 3 .*earlier pacesetter 0\.1.*--name$"):
        Trainer.resume(directory.path)
    assert directory.state_file.read_bytes() == before
    assert not directory.in_use()


@pytest.mark.parametrize("algorithm", ["td3", "trpo"])
def test_a_trainer_that_is_dropped_takes_its_programs_along(algorithm: str, runs: Path) -> None:
    """At once: those of several trainings would else fill the memory of one process."""
    sizes: dict[str, Any] = {"rollout_length": 50} if algorithm == "trpo" else dict(TINY)
    trainer = Trainer(
        algorithm, "Pendulum-v1", runs=runs, **{**sizes, "steps": 900, "hidden": (8,)}
    )
    run_to_end(trainer)
    compiled = weakref.ref(trainer.loop.learners.compiled)
    gc.disable()
    try:
        del trainer
        assert compiled() is None
    finally:
        gc.enable()


def test_an_infinite_keyword_of_a_task_is_kept(runs: Path) -> None:
    """As in Hopper's own default. Nan is refused, since no run could be told to have it."""
    same = {**TINY, "steps": 60, "env_kwargs": {"healthy_z_range": [0.5, math.inf]}}
    trainer = Trainer("td3", "Hopper-v5", runs=runs, **same)
    trainer.loop.tick()
    trainer.save()
    trainer.close()
    directory = run_to_end(Trainer.resume(trainer.directory.path))
    assert directory.settings()["env_kwargs"] == same["env_kwargs"]
    assert directory.difference_from(trainer.config) is None
    run_to_end(Trainer("td3", "Hopper-v5", runs=runs, seed=1, **same))
    with pytest.raises(UsageError, match="tables: nan equals nothing"):
        Trainer("td3", "Hopper-v5", runs=runs, name="x", env_kwargs={"x": [math.nan]})

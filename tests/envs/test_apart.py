"""State that outlives an episode is found, and a run of such a task resumes exactly."""

import json
from pathlib import Path
from typing import Any

import pytest
from broken_envs import Probe
from short_runs import TINY, assert_same, run_to_end, run_to_step

from pacesetter.envs import Environment, Recipe
from pacesetter.envs.apart import Apart, choose
from pacesetter.errors import TrainingError, UsageError
from pacesetter.policy import load
from pacesetter.seeding import Stream
from pacesetter.training.trainer import Trainer

TASKS = {
    "broken_envs:Probe-v0": Apart.BY_RESET,
    "broken_envs:RaisesInClose-v0": Apart.BY_RESET,
    "odd_envs:Fails-v0": Apart.BY_RESET,
    "broken_envs:Ageing-v0": Apart.BY_RENEWAL,
    "odd_envs:Warm-v0": Apart.BY_RENEWAL,
    "broken_envs:Restless-v0": Apart.NOT,
    "Pendulum-v1": Apart.BY_RESET,
    "BipedalWalker-v3": Apart.BY_RENEWAL,
    "BipedalWalkerHardcore-v3": Apart.BY_RENEWAL,
}
RUN = {**TINY, "eval_every": 400, "eval_episodes": 2}


def of_box2d(name: str) -> None:
    """Skip a test of a task that is not installed."""
    if "Bipedal" in name:
        pytest.importorskip("Box2D")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of SWIG, which Box2D is made with
@pytest.mark.parametrize("name", TASKS)
def test_the_test_finds_what_outlives_an_episode(name: str) -> None:
    of_box2d(name)
    assert choose(Recipe(name), None) is TASKS[name]


def test_what_is_wished_is_not_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is a task of Gymnasium's MuJoCo: it costs nothing."""
    monkeypatch.setattr(Recipe, "make", None)
    assert choose(Recipe("broken_envs:Probe-v0"), True) is Apart.BY_RENEWAL
    assert choose(Recipe("broken_envs:Ageing-v0"), False) is Apart.UNTESTED
    for name in ("HalfCheetah-v5", "Humanoid-v4", "pacesetter/Ant111-v4"):
        assert choose(Recipe(name), None) is Apart.BY_RESET


MANNERS: dict[str, dict[str, Any]] = {
    "one member": {},
    "trials select": {"members": 2, "select_on": "eval", "select_every": 300},
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("manner", MANNERS)
@pytest.mark.parametrize("name", ["odd_envs:Warm-v0", "BipedalWalker-v3"])
def test_resumed_run_equals_the_uninterrupted_one(name: str, manner: str, tmp_path: Path) -> None:
    """Training, evaluation and trials, though each kind of env has another past after a stop."""
    of_box2d(name)
    settings = {**RUN, "steps": 1_600, **MANNERS[manner]}
    whole = Trainer("td3", name, runs=tmp_path / "whole", **settings)
    (note,) = whole.notes
    assert f"env: {name}: carries state from one episode to the next" in note
    run_to_end(whole)
    parts = Trainer("td3", name, runs=tmp_path / "parts", **settings)
    for step in (450, 900):
        if manner != "one member":
            step = parts.progress.step + 400
        directory = run_at_least(parts, step)
        parts = Trainer.resume(directory.path)
        assert parts.notes == []
    assert_same(whole.directory, run_to_end(parts))


def run_at_least(trainer: Trainer, step: int) -> Any:
    """Train to the first tick at or beyond a step."""
    for report in trainer:
        if report.step >= step:
            break
    return trainer.directory


def test_way_is_recorded(runs: Path) -> None:
    """In config.json and in the policy file, whose evaluations are then made in the same way."""
    trainer = Trainer("td3", "broken_envs:Ageing-v0", runs=runs, **RUN, steps=100)
    directory = run_to_end(trainer)
    assert json.loads(directory.config_file.read_text())["apart"] == "renewal"
    assert load(directory.policy_file).about["renew_env"] is True
    assert [row["mean"] for row in directory.rows("eval")] == [100.0] * 2


def test_run_of_an_older_version_is_tested_when_it_is_resumed(runs: Path) -> None:
    settings = {**RUN, "steps": 300}
    directory = run_to_step(Trainer("td3", "broken_envs:Ageing-v0", runs=runs, **settings), 50)
    table = json.loads(directory.config_file.read_text())
    del table["apart"]
    directory.config_file.write_text(json.dumps(table))
    trainer = Trainer.resume(directory.path)
    trainer.close()
    assert "made anew" in trainer.notes[0]
    assert directory.record()["resumed"][0]["apart"] == "renewal"
    again = Trainer.resume(directory.path)
    again.close()
    assert again.notes == []
    directory.config_file.write_text(json.dumps(table | {"apart": "ever"}))
    with pytest.raises(UsageError, match=r"apart: must be one of reset, .* got 'ever'"):
        Trainer.resume(directory.path)


def test_what_is_kept_untested_is_said_on_resume(runs: Path) -> None:
    settings = {**RUN, "steps": 300, "renew_env": False}
    trainer = Trainer("td3", "broken_envs:Probe-v0", runs=runs, **settings)
    assert trainer.notes == []
    directory = run_to_step(trainer, 50)
    resumed = Trainer.resume(directory.path)
    resumed.close()
    (note,) = resumed.notes
    assert "Probe-v0: is kept from one episode to the next; if it carries state" in note


def test_renewed_task_that_cannot_be_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run stops with one line, as at any other fault of a task."""
    world = Environment(Recipe("broken_envs:Probe-v0", renew=True), 3, Stream.TRAIN)
    world.reset()
    monkeypatch.setattr(Probe, "__init__", None)
    with pytest.raises(TrainingError, match=r"Probe-v0: episode: failed: UsageError: env: cannot"):
        world.reset()

"""An algorithm of somebody else's, in one file, does all that those of the package do."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import third_party
from pydantic.dataclasses import dataclass as settings
from short_runs import TINY, assert_same, run_to_end
from stopping import stop_at

from pacesetter import algorithms
from pacesetter.cli.main import main
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.evaluation import evaluate
from pacesetter.policy import load
from pacesetter.training.trainer import Trainer

NAME = "third_party:Plain"
TASK = "probe_envs:BothReward-v0"
SMALL: dict[str, Any] = {key: value for key, value in TINY.items() if key != "hidden"}


def start(runs: Path, **settings: Any) -> Trainer:
    return Trainer(NAME, TASK, runs=runs, **{**SMALL, "steps": 800, "gamma": 0.5, **settings})


def test_it_learns_and_its_policy_file_acts(runs: Path) -> None:
    """Reward -4 (a - s/2)^2 for s = -1 or 1."""
    trainer = start(runs, batch_size=64)
    directory = run_to_end(trainer)
    assert directory.path.parts[-2:] == ("third_party-Plain", "0")
    last = directory.rows()[-1]
    assert (last["step"], last["updates"], last["plain_updates"]) == (800, 700, 700)
    assert {"actor_loss", "critic_loss"} <= directory.rows("train")[-1].keys()
    policy = load(directory.policy_file)
    np.testing.assert_allclose(policy(np.array([[-1], [1]])), [[-0.5], [0.5]], atol=0.1)
    assert policy.about["algorithm"] == NAME
    assert evaluate(policy, TASK, episodes=20).mean > -0.05
    assert evaluate(None, TASK, episodes=20).mean < -0.5


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"members": 2, "copy": "weights", "normalize_observation": True},
        pytest.param(
            {"members": 2, "copy": "actor", "replay": "prioritized", "n_step": 3},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["alone", "weights", "actor"],
)
def test_stopped_run_equals_uninterrupted(settings: dict[str, Any], runs: Path) -> None:
    settings = {"steps": 500, **settings}
    whole = run_to_end(start(runs, name="whole", **settings))
    stopped = start(runs, name="stopped", **settings)
    for tick in (60, 150):
        stop_at(stopped, tick)
        assert not stopped.finished
        stopped = Trainer.resume(stopped.directory.path)
        assert stopped.notes == []
    assert_same(whole, run_to_end(stopped))


def test_its_settings_are_flags(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", NAME, TASK, "--help"])
    text = capsys.readouterr().out
    flags = ("--width", "units of the one hidden layer", "--noise", "--n-step", "--members")
    assert [flag for flag in flags if flag not in text] == []
    assert main(["train", NAME, TASK, "--width", "0", "--runs", str(runs)]) == 2
    assert "width: should be greater than or equal to 1, got" in capsys.readouterr().err
    assert main(["train", NAME, TASK, "--hidden", "8", "--runs", str(runs)]) == 2
    assert not runs.exists()


def test_an_installed_package_can_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By its entry point; the name has a `multi-` form then, and `list` shows it."""
    folder = tmp_path / "bare-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: bare\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[pacesetter.algorithms]\nbare = {NAME}\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert algorithms.find("bare") is third_party.Plain
    config = resolve("multi-bare", TASK, {"width": 7})
    assert (config.run.algorithm, config.run.members, config.hyper.width) == ("bare", 2, 7)
    assert main(["list", "algorithms"]) == 0
    assert NAME in capsys.readouterr().out


@pytest.mark.slow
def test_commands_know_it_from_its_file_alone(tmp_path: Path) -> None:
    """Each in a process of its own, which finds the file on its path and nothing else of it."""
    allow = ["--allow", "bare:Plain"]  # the run's file names code
    there = tmp_path / "there"
    there.mkdir()
    (there / "bare.py").write_text(Path(third_party.__file__).read_text())
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in SMALL.items()]
    path = os.pathsep.join([str(there), str(Path(algorithms.__file__).parents[2])])
    env = os.environ | {"PYTHONPATH": path}

    def run(*words: str) -> str:
        command = [sys.executable, "-m", "pacesetter", *words]
        found = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env)
        assert (found.returncode, found.stderr) == (0, "")
        return found.stdout

    run("train", "bare:Plain", "Pendulum-v1", "--steps", "400", "-q", *flags)
    assert "800 steps, return" in run("resume", "bare-Plain/0", *allow, "--steps", "800", "-q")
    told = json.loads(run("eval", "bare-Plain/0", *allow, "--episodes", "2", "--json"))
    assert len(told["returns"]) == 2
    assert "bare:Plain" in run("show", "bare-Plain/0")
    assert "800 of 800" in run("list", "runs")
    assert "bare-Plain" in run("compare", "runs/Pendulum-v1/bare-Plain/0")
    words = ["--algos", "bare:Plain", "--envs", "Pendulum-v1", "--steps=300", "--runs=more"]
    run("bench", *words, *flags, "-q")
    assert "300 of 300" in run("list", "runs", "--runs", "more")


@settings(frozen=True)
class OfNoKind:
    """Settings that say neither where data come from nor how many envs there are."""

    width: int = 8


class WithoutKind:
    Hyper = OfNoKind


class WithoutClass:
    Hyper = OfNoKind()


@pytest.mark.parametrize("name", ["WithoutKind", "WithoutClass", "OfNoKind"])
def test_settings_of_no_kind_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match=rf"^algorithm: cannot load '{__name__}:{name}': .*Hyper"):
        algorithms.find(f"{__name__}:{name}")


def test_ensemble_of_a_foreign_algorithm_has_its_own_name() -> None:
    run, _ = resolve("multi-third_party:Plain", "Pendulum-v1")
    assert (run.algorithm, run.members, run.rule) == ("third_party:Plain", 2, "best")
    assert run.name == "multi-third_party-Plain"

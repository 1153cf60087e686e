"""Ids: the newest version of a name, modules in the current folder, and packages that are known."""

import sys
from pathlib import Path
from typing import Any

import pytest
from short_runs import TINY, run_to_end

from pacesetter.cli.main import main
from pacesetter.envs import Recipe
from pacesetter.envs.ids import full_id
from pacesetter.training.trainer import Trainer

SMALL = ["--steps", "60", "--eval-episodes", "1", "--hidden", "8", "--warmup", "50", "-q"]
PLAIN = """
import gymnasium
from broken_envs import Probe

class Task(Probe):
    pass

gymnasium.register("Plain", entry_point=Task)
"""


def test_newest_version() -> None:
    found = {"HalfCheetah": "HalfCheetah-v5", "Pendulum": "Pendulum-v1", "Ant-v4": "Ant-v4"}
    found |= {"pacesetter/Ant111": "pacesetter/Ant111-v4", "Zzz": "Zzz", "m:Ant": "m:Ant"}
    for name, full in found.items():
        assert full_id(name) == full


def test_run_without_a_version_says_which_it_takes(runs: Path) -> None:
    """Once; the run is of the full id, so that a later Gymnasium does not change it."""
    trainer = Trainer("td3", "Pendulum", runs=runs, **TINY, steps=50)
    assert trainer.notes[0] == "env: 'Pendulum' has no version; taking the newest, Pendulum-v1"
    directory = run_to_end(trainer)
    assert directory.path == runs / "Pendulum-v1" / "td3" / "0"
    assert directory.settings()["env"] == "Pendulum-v1"
    again = Trainer.resume(directory.path, steps=60)
    again.close()
    assert again.notes == []


def test_id_that_is_registered_without_a_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a module of the current folder, which is looked at because the command names it."""
    (tmp_path / "plain_task.py").write_text(PLAIN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert main(["train", "td3", "plain_task:Plain", *SMALL]) == 0
    assert sys.path[-1] == str(tmp_path)
    assert (tmp_path / "runs" / "plain_task-Plain" / "td3" / "0").is_dir()


def test_current_folder_is_not_looked_at_unasked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    before = [*sys.path]
    assert main(["train", "td3", "Pendulum-v1", *SMALL]) == 0
    assert main(["train", "td3", "Zzz-v1", *SMALL]) == 2
    assert sys.path == before


def test_module_that_is_not_found(capsys: pytest.CaptureFixture[str]) -> None:
    """The line says where it is looked for."""
    assert main(["train", "td3", "no_such_module:Id-v0"]) == 2
    assert "must be the current one or in PYTHONPATH" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{a = 1, b = [2.5]}", {"a": 1, "b": [2.5]}),
        ('{"a": {"b": true}}', {"a": {"b": True}}),
        ("{no table", "{no table"),
        ("[" * 5000, "[" * 5000),
    ],
)
def test_tables_as_keywords(text: str, value: Any) -> None:
    from pacesetter.cli.flags import split_env_kwargs

    assert split_env_kwargs(["--env.KEY", text, "-q"]) == (["-q"], {"KEY": value})


def test_tasks_need_no_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    Recipe("Pendulum-v1").make().close()

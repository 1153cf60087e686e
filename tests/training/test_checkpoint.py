"""A checkpoint belongs to its settings and to its log; whatever differs is named."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from short_runs import TINY, assert_same, run_to_end

from pacesetter import storage
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory
from pacesetter.storage import Content
from pacesetter.training.trainer import Trainer

SHORT: dict[str, Any] = {**TINY, "steps": 250, "eval_every": 50}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped at step 150 of 250 and went on for some rows, unsaved."""
    trainer = Trainer("td3", "Pendulum-v1", runs=tmp_path_factory.mktemp("made"), **SHORT)
    for report in trainer:
        if report.step >= 150:
            break
    trainer.directory.log.append({"kind": "train", "step": 151})
    return trainer.directory.path


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """The same run without a stop."""
    return run_to_end(Trainer("td3", "Pendulum-v1", runs=tmp_path_factory.mktemp("whole"), **SHORT))


@pytest.fixture
def run(made: Path, runs: Path) -> RunDirectory:
    """A copy of the stopped run."""
    shutil.copytree(made, runs / "run")
    return RunDirectory(runs / "run")


def edit(run: RunDirectory, **settings: Any) -> None:
    table = json.loads(run.config_file.read_text())
    assert table["settings"].keys() >= settings.keys()
    table["settings"] |= settings
    run.config_file.write_text(json.dumps(table))


def files(run: RunDirectory) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}


CHANGES = {
    "gamma": 0.9,
    "critic_learning_rate": 1e-2,
    "batch_size": 32,
    "n_step": 3,
    "replay_size": 20_000,
    "eval_every": 25,
    "hidden": [16, 8],
    "env_kwargs": {"g": 9.0},
    "seed": 1,
}


@pytest.mark.parametrize("key", CHANGES)
def test_other_settings_are_named(key: str, run: RunDirectory) -> None:
    """Before anything is opened; the run stays as it is."""
    old = run.settings()[key]
    edit(run, **{key: CHANGES[key]})
    before = files(run)
    with pytest.raises(UsageError) as refusal:
        Trainer.resume(run.path)
    assert f"config.json: has {key}={CHANGES[key]}, not {old} as" in str(refusal.value)
    assert files(run) == before


def test_every_setting_that_differs_is_named(run: RunDirectory) -> None:
    edit(run, gamma=0.9, tau=0.1)
    with pytest.raises(UsageError, match=r"gamma=0.9, not 0.99, tau=0.1, not 0.005 as"):
        Trainer.resume(run.path)


def test_a_budget_may_change(run: RunDirectory, whole: RunDirectory) -> None:
    """By a flag as by an edit; so may what changes no result."""
    edit(run, steps=200, checkpoint_every=5.0, name="renamed")
    resumed = Trainer.resume(run.path, steps=250, time="1h")
    assert resumed.notes == []
    run_to_end(resumed)
    edit(run, name="td3")
    assert_same(whole, run)


def test_a_checkpoint_that_tells_nothing_is_taken(run: RunDirectory, whole: RunDirectory) -> None:
    """As the first ones of this schema."""
    arrays, table = storage.read(run.state_file, "checkpoint")
    del table["settings"], table["log_hash"]
    storage.write(run.state_file, "checkpoint", Content(arrays, table))
    run.previous_file.unlink()
    resumed = Trainer.resume(run.path)
    assert resumed.notes == []
    assert_same(whole, run_to_end(resumed))


def test_a_setting_newer_than_the_checkpoint_is_no_difference(
    run: RunDirectory, whole: RunDirectory
) -> None:
    arrays, table = storage.read(run.state_file, "checkpoint")
    del table["settings"]["tau"]
    storage.write(run.state_file, "checkpoint", Content(arrays, table))
    assert_same(whole, run_to_end(Trainer.resume(run.path)))


# The log.


def other_number(log: bytes) -> bytes:
    return log.replace(b'"step": 50', b'"step": 51', 1)


def other_line(log: bytes) -> bytes:
    return b"\xff" + log[1:]


@pytest.mark.parametrize("change", [other_number, other_line])
def test_another_log_is_refused(change: Callable[[bytes], bytes], run: RunDirectory) -> None:
    log = run.metrics_file.read_bytes()
    assert change(log) != log
    run.metrics_file.write_bytes(change(log))
    before = files(run)
    with pytest.raises(UsageError, match=r"metrics.jsonl: its first [\d,]+ bytes are not those"):
        Trainer.resume(run.path)
    assert {k: v for k, v in files(run).items() if k.name != "lock"} == {
        k: v for k, v in before.items() if k.name != "lock"
    }
    run.metrics_file.unlink()  # as the line says
    assert run_to_end(Trainer.resume(run.path)).rows()[-1]["step"] == 250


def test_a_log_cut_within_a_line_is_not_glued(run: RunDirectory) -> None:
    """What is lost is said; every line stays one row."""
    lines = run.metrics_file.read_bytes().splitlines(keepends=True)
    run.metrics_file.write_bytes(b"".join(lines[:2]) + lines[2][:20])
    resumed = Trainer.resume(run.path)
    assert any("rows of the log are missing" in note for note in resumed.notes)
    rows = run_to_end(resumed).rows()
    assert [json.dumps(row) for row in rows[:2]] == [line.decode().strip() for line in lines[:2]]
    assert rows[-1]["step"] == 250


def test_less_of_a_log_that_cannot_be_read_is_refused(run: RunDirectory) -> None:
    run.metrics_file.write_bytes(b"step,return\n0,1\n")
    with pytest.raises(UsageError, match=r"metrics.jsonl: damaged"):
        Trainer.resume(run.path)

"""What a run's folder may hold, and what a run may do to what is there."""

import errno
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from odd_places import folder, pipe
from short_runs import TINY, assert_same, log, run_to_end

from pacesetter import files
from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory, find, find_all
from pacesetter.training import trainer as trainers
from pacesetter.training.trainer import Trainer

TASK = "Pendulum-v1"
SHORT: dict[str, Any] = {**TINY, "steps": 250, "eval_every": 100}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped at step 200 of 250, and its checkpoint of step 100 kept."""
    runs = tmp_path_factory.mktemp("made")
    trainer = Trainer("td3", TASK, runs=runs, **SHORT)
    for stop in (100, 200):
        for report in trainer:
            if report.kind == "eval" and report.step >= stop:
                break
        trainer = Trainer.resume(trainer.directory.path)
    trainer.close()
    return trainer.directory.path


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """The same run without a stop."""
    return run_to_end(Trainer("td3", TASK, runs=tmp_path_factory.mktemp("whole"), **SHORT))


@pytest.fixture
def run(made: Path, runs: Path) -> RunDirectory:
    """A copy of the stopped run."""
    path = runs / TASK / "td3" / "0"
    shutil.copytree(made, path)
    return RunDirectory(path)


def tree(folder: Path) -> dict[str, bytes | None]:
    """Everything below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


# Only what a call made is removed.


def fail_at_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise UsageError("cannot reserve 7 MB for the replay")

    monkeypatch.setattr(trainers.checkpoint, "save", fail)


def fail_at_config(monkeypatch: pytest.MonkeyPatch) -> None:
    fail_to_sync(monkeypatch, stat.S_ISREG)


def fail_at_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    fail_to_sync(monkeypatch, stat.S_ISDIR)


def fail_to_sync(monkeypatch: pytest.MonkeyPatch, kind: Callable[[int], bool]) -> None:
    sync = os.fsync

    def full(file: int) -> None:
        if kind(os.fstat(file).st_mode):
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(file)

    monkeypatch.setattr(os, "fsync", full)


FAILURES = [
    fail_at_replay,
    fail_at_config,
    fail_at_folder,
]


@pytest.mark.parametrize("fail", FAILURES)
@pytest.mark.parametrize("there", [(), ("0",), ("0/notes.txt", "0/last/plan.txt"), ("../other",)])
def test_a_start_that_fails_leaves_what_was_there(
    fail: Callable[[pytest.MonkeyPatch], None],
    there: tuple[str, ...],
    runs: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in there:
        path = runs / TASK / "td3" / name
        (path.parent if path.suffix else path).mkdir(parents=True, exist_ok=True)
        if path.suffix:
            path.write_text("a user's own")
    before = tree(runs.parent)
    fail(monkeypatch)
    with pytest.raises(UsageError, match=r"cannot (reserve|write)"):
        Trainer("td3", TASK, runs=runs, **SHORT)
    assert tree(runs.parent) == before


def test_litter_of_a_killed_process_is_swept(run: RunDirectory) -> None:
    for place in (run.path, run.policies, run.state_file.parent):
        place.mkdir(exist_ok=True)
        (place / f"file{files.TEMPORARY}").touch()
    Trainer.resume(run.path).close()
    assert not [*run.path.rglob(f"*{files.TEMPORARY}")]


def test_a_name_too_long_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", "td3", TASK, "--name", "n" * 300, "--steps", "100"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "File name too long" in error
    assert not [*tmp_path.iterdir()]


def test_a_start_onto_a_held_folder_leaves_it(runs: Path) -> None:
    """Its lock too: without it, a third process could take the folder."""
    holder = RunDirectory(runs / TASK / "td3" / "0")
    holder.path.mkdir(parents=True)
    holder.lock()
    before = tree(runs)
    with pytest.raises(UsageError, match="in use"):
        Trainer("td3", TASK, runs=runs, **SHORT)
    assert tree(runs) == before
    assert holder.in_use()
    holder.unlock()


@pytest.mark.parametrize(
    "left", ["metrics.jsonl", "last/previous.safetensors", "last/replay-0.bin"]
)
def test_a_run_without_its_config_is_not_trained_over(left: str, run: RunDirectory) -> None:
    for file in (run.config_file, *run.files):
        if not file.match(left):
            file.unlink()
    before = tree(run.path)
    with pytest.raises(UsageError, match=rf"has a run's {Path(left).name} but no config.json"):
        Trainer("td3", TASK, runs=run.path.parents[2], **SHORT)
    assert tree(run.path) == before


# Links, pipes and folders in place of files.


def link(path: Path) -> None:
    other = path.with_name("another's")
    other.write_bytes(b"untouched")
    path.unlink()
    path.symlink_to(other)


ODD = (link, pipe, folder)
READ_OR_APPENDED = ("config.json", "metrics.jsonl", "lock", "last/replay-0.bin")


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("name", READ_OR_APPENDED)
def test_what_is_no_file_is_refused(
    name: str, odd: Callable[[Path], None], run: RunDirectory, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line that names it; whoever only looks at the run neither waits nor ends on it."""
    odd(run.path / name)
    runs = run.path.parents[2]
    before = {path: os.lstat(path).st_mode for path in runs.rglob("*")}
    assert main(["resume", str(run.path), "-q"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert Path(name).name in error
    assert "is not a regular file" in error
    assert {path: os.lstat(path).st_mode for path in runs.rglob("*")} == before
    if odd is link:
        assert (run.path / name).with_name("another's").read_bytes() == b"untouched"
    assert main(["list", "runs", "--runs", str(runs)]) == 0
    assert main(["show", str(run.path)]) == (2 if name in READ_OR_APPENDED[:2] else 0)
    assert main(["eval", str(run.path), "--episodes", "1"]) == 0


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("name", ["last/state.safetensors", "policy.safetensors"])
def test_what_is_no_file_is_renamed_where_a_run_writes_one(
    name: str, odd: Callable[[Path], None], run: RunDirectory, whole: RunDirectory
) -> None:
    """The checkpoint before is taken, and nothing is lost or written through."""
    odd(path := run.path / name)
    kind = os.lstat(path).st_mode
    trainer = Trainer.resume(run.path)
    assert any(f"{path}" in note and "is not a regular file" in note for note in trainer.notes)
    assert_same(whole, run_to_end(trainer))
    assert log(run) == log(whole)
    assert files.is_regular(path)
    aside = path.with_name(f"{path.name}.aside")
    assert os.lstat(aside).st_mode == kind
    if odd is folder:
        assert (aside / "inside").read_text() == "a user's own"
    if odd is link:
        assert path.with_name("another's").read_bytes() == b"untouched"


def test_eval_of_a_policy_that_is_a_pipe(
    run: RunDirectory, capsys: pytest.CaptureFixture[str]
) -> None:
    pipe(run.policy_file)
    assert main(["eval", str(run.path)]) == 2
    assert "policy.safetensors is not a regular file" in capsys.readouterr().err


# Folders that are links.


def test_a_run_that_was_moved_is_found_through_its_link(
    run: RunDirectory, tmp_path: Path, whole: RunDirectory
) -> None:
    runs, group = run.path.parents[2], run.path.parent
    shutil.move(group, tmp_path / "bigger")
    group.symlink_to(tmp_path / "bigger")
    (runs / "circle").symlink_to(runs)
    assert [found.path for found in find_all(runs)] == [run.path]
    assert find("td3/0", runs).path == run.path
    assert_same(whole, run_to_end(Trainer.resume(run.path)))

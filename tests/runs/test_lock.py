"""A lock ends with its process, also where the file system has none."""

import errno
import fcntl
import os
import platform
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pacesetter.errors import InUseError
from pacesetter.runs import lock as lock_module
from pacesetter.runs.lock import Lock, alone

HOLD = """
import sys, errno, fcntl, time
from pathlib import Path
from pacesetter.runs.lock import Lock

def no_locks(*arguments):
    raise OSError(errno.ENOSYS, "Function not implemented")

if sys.argv[2] == "weak":
    fcntl.flock = no_locks
lock = Lock(Path(sys.argv[1]))
lock.take()
print("held", flush=True)
time.sleep(600)
"""


@pytest.fixture(params=["flock", "weak"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A file system with locks, and one that has none."""

    def no_locks(*arguments: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    if request.param == "weak":
        monkeypatch.setattr(fcntl, "flock", no_locks)
    return request.param


def test_one_holder_at_a_time(kind: str, tmp_path: Path) -> None:
    first, second = Lock(tmp_path / "lock"), Lock(tmp_path / "lock")
    assert not first.is_held()
    first.take()
    assert first.is_weak == (kind == "weak")
    assert second.is_held()
    with pytest.raises(
        InUseError, match=f"in use by process {os.getpid()} on {platform.node()}; wait"
    ):
        second.take()
    first.free()
    assert not second.is_held()
    with alone(second):
        assert first.is_held()
    assert not first.is_held()


def test_a_killed_holder_holds_nothing(kind: str, tmp_path: Path) -> None:
    lock = Lock(tmp_path / "lock")
    command = [sys.executable, "-c", HOLD, str(lock.path), kind]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "held\n"
            assert lock.is_held()
            with pytest.raises(InUseError, match=f"process {holder.pid} on"):
                lock.take()
        finally:
            holder.send_signal(signal.SIGKILL)
    assert not lock.is_held()
    lock.take()
    lock.free()


def test_another_machine_without_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody can tell whether it still runs, so a person must, and a run of it is in use."""
    lock = Lock(tmp_path / "lock")
    lock.path.write_text("process 1 on elsewhere\n")
    lock.take()  # with locks, what the text says is of the past
    lock.free()

    def no_locks(*arguments: Any) -> None:
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    lock.path.write_text("process 1 on elsewhere\n")
    assert lock.is_held()
    said = rf"process 1 on elsewhere.*remove {lock.path}$"
    with pytest.raises(InUseError, match=said):
        lock.take()
    with pytest.raises(InUseError, match=said), alone(lock):  # which else waits for ever
        pass
    lock.path.write_text("")
    assert not lock.is_held()


def test_a_lock_that_was_removed_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever undoes its start removes the file, perhaps after another has opened it."""
    lock, other, flock = Lock(tmp_path / "lock"), Lock(tmp_path / "lock"), fcntl.flock

    def remove_first(file: Any, how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", flock)
        lock.path.unlink()
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", remove_first)
    lock.take()
    with pytest.raises(InUseError):
        other.take()
    lock.free()


def test_a_look_at_a_lock_keeps_nobody_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`is_held` locks the file for a moment, in which another may start."""
    lock = Lock(tmp_path / "lock")
    looking = lock.path.open("w")
    fcntl.flock(looking, fcntl.LOCK_SH)
    monkeypatch.setattr(lock_module.time, "sleep", lambda seconds: looking.close())
    lock.take()
    lock.free()

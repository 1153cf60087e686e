"""NPROC is read once: what is used, what is recorded and what is said agree."""

import os
from pathlib import Path

import pytest

from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.process import cores, fix_threads, threads
from pacesetter.runs.provenance import provenance


@pytest.mark.parametrize("text", ["x", "0", "-1", "1.5", "2 3", "1e3"])
def test_a_bad_number_of_threads_is_one_line(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("NPROC", text)
    with pytest.raises(UsageError, match="NPROC"):
        threads()
    runs = tmp_path / "runs"
    assert main(["train", "td3", "HalfCheetah-v5", "--steps", "20", "--runs", str(runs)]) == 2
    output = capsys.readouterr()
    assert output.err.count("\n") == 1
    assert "NPROC" in output.err
    assert f"'{text}'" in output.err
    assert not runs.exists()


@pytest.mark.parametrize(("text", "count"), [("1", 1), ("3", 3), (" 2 ", 2), ("", None)])
def test_what_is_used_is_what_is_recorded(
    text: str, count: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NPROC", text)
    expected = count or len(cores())
    assert threads() == expected
    assert provenance(None)["threads"] == expected
    fix_threads()  # which XLA reads for itself
    assert os.environ["NPROC"] == str(expected)


def test_an_unset_number_is_one_thread_per_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NPROC", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 8})
    assert threads() == 3
    fix_threads(2)  # a resumed run's own
    assert (os.environ["NPROC"], threads()) == ("2", 2)

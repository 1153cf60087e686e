"""What a process takes from its environment, and how signals end it from its first moments on."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pacesetter import process
from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.process import (
    CODES,
    cores,
    exit_code,
    fix_threads,
    forget_jax_settings,
    multiplies_bfloat16,
    stopping,
    threads,
)
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
    assert provenance()["threads"] == expected
    fix_threads()  # which XLA reads for itself
    assert os.environ["NPROC"] == str(expected)


def test_a_system_that_tells_no_cores_has_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """As macOS."""
    monkeypatch.delattr(os, "sched_getaffinity")
    assert process.cores() == list(range(os.cpu_count() or 1))


def test_an_unset_number_is_one_thread_per_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NPROC", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 8})
    assert threads() == 3
    fix_threads(2)  # a resumed run's own
    assert (os.environ["NPROC"], threads()) == ("2", 2)


EARLY = """
import os, sys

module, number = sys.argv[1:]

class Early:
    def find_spec(self, name, *rest):
        if name == module:
            os.kill(os.getpid(), int(number))

sys.meta_path.insert(0, Early())
from pacesetter.__main__ import main
sys.argv[1:] = ["list", "rules"]
sys.exit(main())
"""


@pytest.mark.parametrize("number", CODES)
@pytest.mark.parametrize("module", ["pacesetter.cli.main", "pydantic"])
def test_signal_while_the_command_is_imported(number: int, module: str) -> None:
    """It ends at once, without a word."""
    words = [sys.executable, "-c", EARLY, module, str(int(number))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=10)
    assert (done.returncode, done.stdout, done.stderr) == (CODES[number], "", "")


INSIDE = """
import os, sys
from pacesetter.__main__ import main
from pacesetter.cli import main as command

def verb(words):
    os.kill(os.getpid(), int(words[0]))

command.VERBS["verb"] = verb
sys.exit(main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_signal_to_a_verb_that_saves_nothing(number: int) -> None:
    words = [sys.executable, "-c", INSIDE, "verb", str(int(number))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (CODES[number], "", "")


ENDS = """
import ctypes, os, sys
from pacesetter.__main__ import main
from pacesetter.cli import main as command

def fork_and_exit(words):
    if os.fork() == 0:
        ctypes.CDLL(None).exit(7)
    return os.waitstatus_to_exitcode(os.wait()[1])

command.VERBS.update(
    c=lambda words: ctypes.CDLL(None).exit(0),
    locked=lambda words: ctypes.PyDLL(None).exit(0),
    child=fork_and_exit,
    fine=lambda words: 0,
    code=lambda words: 75,
    fault=lambda words: 1 // 0,
)
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("verb", "code", "said"),
    [
        ("c", 1, "has exited"),
        ("locked", 1, "has exited"),
        ("child", 7, ""),
        ("fine", 0, ""),
        ("code", 75, ""),
        ("fault", 1, "ZeroDivisionError"),
    ],
)
def test_no_library_ends_the_command_as_if_it_were_done(verb: str, code: int, said: str) -> None:
    words = [sys.executable, "-c", ENDS, verb]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (code, "")
    assert said in done.stderr
    assert bool(said) == bool(done.stderr)


def test_a_hangup_that_is_ignored_stays_ignored() -> None:
    """As `nohup` does it; the other signals are taken."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopping(lambda: None) as received:
            signal.raise_signal(signal.SIGHUP)
            assert received == []
            signal.raise_signal(signal.SIGTERM)
            assert received == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", CODES)
def test_the_first_signal_asks_for_the_end(number: int) -> None:
    before = signal.getsignal(number)
    with stopping(lambda: asked.append(number)) as received:
        asked: list[int] = []
        signal.raise_signal(number)
        assert asked == received == [number]
        assert exit_code(received) == CODES[number]
    assert signal.getsignal(number) == before


# The environment.


def test_settings_of_jax_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """All but those that say where it runs."""
    for name in [name for name in os.environ if name.startswith(("JAX_", "XLA_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("JAX_ENABLE_X64", "banana")
    monkeypatch.setenv("JAX_RANDOM_SEED_OFFSET", "3")
    monkeypatch.setenv("XLA_FLAGS", "--nonsense")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert forget_jax_settings() == ["JAX_ENABLE_X64", "JAX_RANDOM_SEED_OFFSET", "XLA_FLAGS"]
    left = {name for name in os.environ if name.startswith(("JAX_", "XLA_"))}
    assert left == {"JAX_PLATFORMS"}


def test_a_bad_environment_is_a_line_each(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "pacesetter", "train", "td3", "Pendulum-v1", "-q"]
    bad = {"JAX_ENABLE_X64": "banana", "JAX_PLATFORMS": "abacus"}
    done = subprocess.run(
        words, env=os.environ | bad, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout) == (2, "")
    ignored, refused = done.stderr.splitlines()
    assert ignored.startswith("pacesetter: ignored JAX_ENABLE_X64")
    assert refused == (
        "pacesetter: JAX_PLATFORMS: this machine has no 'abacus'; unset it, or set it to cpu"
    )
    assert not (tmp_path / "runs").exists()


def test_a_run_records_a_command_that_can_be_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that `bench` makes by `python -m pacesetter`."""
    for program in ("/venv/bin/pacesetter", "/src/pacesetter/__main__.py"):
        monkeypatch.setattr(sys, "argv", [program, "train", "td3", "Ant-v5"])
        assert provenance()["command"] == "pacesetter train td3 Ant-v5"


@pytest.mark.parametrize(
    ("flags", "has"), [("fpu avx2 avx512_bf16", True), ("fpu avx2", False), (None, False)]
)
def test_who_multiplies_bfloat16(
    flags: str | None, has: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(path: Path, encoding: str) -> str:
        if flags is None:
            raise FileNotFoundError
        return f"processor\t: 0\nflags\t\t: {flags}\n"

    monkeypatch.setattr(Path, "read_text", read)
    assert multiplies_bfloat16() == has

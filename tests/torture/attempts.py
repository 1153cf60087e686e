"""One command on one odd input, in this process: how it ended, how long it took, what it ran."""

import io
import resource
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pacesetter.cli.main import main
from pacesetter.errors import TrainingError, UsageError

SECONDS = 1.0  # of the processor, that one attempt may take
MEGABYTES = 100  # that one attempt may add to the peak
# What a file must never make a command do; git is asked for the commit.
ALARMS = ("os.system", "os.exec", "os.posix_spawn", "pickle.find_class", "socket.connect")
FINE = "settings are fine; nothing is trained here"  # said in place of a run
INTRUDER = "intruder"

_ran: list[str] = []


def _listen(event: str, arguments: tuple[Any, ...]) -> None:
    if (
        event in ALARMS
        or (event == "import" and str(arguments[0]).split(".")[0] == INTRUDER)
        or (event == "subprocess.Popen" and "git" not in str(arguments[0]))
    ):
        _ran.append(f"{event} {arguments[0]!r}")


sys.addaudithook(_listen)


@dataclass
class Tally:
    """Attempts so far, and what was wrong with each that was."""

    made: int = 0
    refused: int = 0
    slowest: float = 0.0
    largest: float = 0.0  # megabytes that one attempt added to this process's peak
    megabytes: float = 0.0  # megabytes that all together added to it
    wrong: list[str] = field(default_factory=list[str])
    values: dict[str, float] = field(default_factory=dict[str, float])  # what else was measured
    before: int = field(default_factory=lambda: _peak())

    @property
    def passed(self) -> bool:
        """Whether the targets are met."""
        return not self.wrong and self.largest < MEGABYTES

    def of_processes(self) -> str:
        """As the table of docs/reliability.md tells of processes."""
        worst = f"; gone in {self.slowest:.1f} s at most" if self.slowest else ""
        return f"{self.made:,} made, {len(self.wrong)} faults{worst}"

    def table(self) -> str:
        """As the table of docs/reliability.md tells of files and words."""
        tracebacks = sum(": traceback" in each for each in self.wrong)
        ran = sum(": code run" in each for each in self.wrong)
        cost = f"{self.largest:.0f} MB and {self.slowest:.2f} CPU seconds at most"
        return (
            f"{self.made:,} made, {self.refused:,} refused in one line; {tracebacks} tracebacks, "
            f"{ran} code run, {len(self.wrong) - tracebacks - ran} other faults; "
            f"{cost} ({self.megabytes:.0f} MB for all together)"
        )


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB


def attempt(tally: Tally, about: str, action: Callable[[], Any]) -> None:
    """Do one thing that may only succeed, or be refused in one line."""
    _ran.clear()
    began, before = time.thread_time(), _peak()
    fault = ""
    try:
        action()
    except (UsageError, TrainingError) as error:
        tally.refused += FINE not in str(error)
        fault = "" if str(error).isprintable() else f"unprintable: {error!r}"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"traceback: {type(error).__name__}: {error!s:.80} ({where.name}, {where.lineno})"
    spent = time.thread_time() - began
    tally.made += 1
    tally.largest = max(tally.largest, (_peak() - before) / 1024)
    tally.megabytes = (_peak() - tally.before) / 1024
    tally.slowest = max(tally.slowest, spent)
    if _ran:
        fault = f"code run: {_ran[0]}"
    elif spent > SECONDS and not fault:
        fault = f"slow: {spent:.1f} s"
    if fault:
        tally.wrong.append(f"{about}: {fault}")


def command(*words: object) -> Callable[[], None]:
    """A command line as an action: it raises what a person would see as a refusal."""

    def act() -> None:
        out, err = _stream(), _stream()
        with redirect_stdout(out), redirect_stderr(err):
            try:
                code = main([str(word) for word in words])
            except SystemExit as end:
                code = int(end.code or 0)
        said, lines = _text(err), _text(err).strip("\n").split("\n")
        if code:
            _check_refusal(code, said, lines)
            raise UsageError(lines[-1])
        _check_escapes(_text(out))

    return act


def _check_refusal(code: int, said: str, lines: list[str]) -> None:
    if code not in (1, 2, 75) or len(lines) > 3 or not lines[-1].startswith("pacesetter: "):
        raise AssertionError(f"exit {code} without one line: {said[-200:]!r}")
    _check_escapes(said)


def _check_escapes(text: str) -> None:
    if any(not (letter.isprintable() or letter in "\n\t\r") for letter in text):
        raise AssertionError(f"control characters reach the terminal: {text!r:.200}")


def _stream() -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace")


def _text(stream: io.TextIOWrapper) -> str:
    stream.flush()
    buffer: Any = stream.buffer
    return buffer.getvalue().decode("utf-8", "backslashreplace")


@contextmanager
def trap(folder: Path) -> Iterator[None]:
    """A folder in which a module lies in wait that no file may have imported."""
    (folder / f"{INTRUDER}.py").write_text("raise SystemExit('the intruder ran')\n")
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


@contextmanager
def patched(holder: Any, name: str, value: Any) -> Iterator[None]:
    """An attribute replaced for a while."""
    before = getattr(holder, name)
    setattr(holder, name, value)
    try:
        yield
    finally:
        setattr(holder, name, before)

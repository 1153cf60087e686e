"""A command's process: its cores, threads and environment, and how signals end it."""

import ctypes
import os
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from pacesetter.errors import UsageError

# The exit code of a process that a signal ends; SIGUSR1 is a scheduler's warning of its SIGTERM.
CODES: dict[int, int] = {
    signal.SIGINT: 130,
    signal.SIGTERM: 143,
    signal.SIGHUP: 129,
    signal.SIGUSR1: 143,
}
# Where JAX runs and what it keeps. All else that it reads from the environment may change the
# numbers of a seed, or end the command with a traceback.
KEPT = {
    "JAX_PLATFORMS",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_CUDA_VISIBLE_DEVICES",
    "JAX_ROCM_VISIBLE_DEVICES",
}
_exit = os._exit  # which is another while a task is called
_kept_for_c: list[Any] = []  # functions that C may call until the process ends
Handler = Callable[[int, FrameType | None], None]


class Interrupted(KeyboardInterrupt):
    """A signal that ends a command which has nothing to save; its argument is the signal."""


def cores() -> list[int]:
    """The cores that this process may use; all of the machine where a system does not tell."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def threads() -> int:
    """The size of XLA's thread pool on a CPU: NPROC, by default one thread per core.

    It decides the last bits of results. Raises UsageError if NPROC is anything else.
    """
    text = os.environ.get("NPROC", "").strip()
    if not text:
        return len(cores())
    if not (text.isdecimal() and int(text) >= 1):
        raise UsageError(
            f"NPROC: must be a whole number of threads, at least 1, got '{text}'; "
            "unset it for one thread per core"
        )
    return int(text)


def fix_threads(count: int | None = None) -> None:
    """Fix the number of threads before JAX is imported, so that XLA takes it too."""
    os.environ["NPROC"] = str(count or threads())


def forget_jax_settings() -> list[str]:
    """Take out of the environment what changes the numbers of a seed; the names of what was set.

    To be called before JAX is imported, which reads them then.
    """
    names = [name for name in os.environ if name.startswith("JAX_") and name not in KEPT]
    names += [name for name in ("XLA_FLAGS",) if name in os.environ]
    for name in names:
        del os.environ[name]
    return sorted(names)


def leave(number: int, frame: FrameType | None) -> None:
    """End at once and without a word: nothing has begun."""
    _exit(CODES[number])


def interrupt(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that files and helpers are closed on the way out."""
    raise Interrupted(number)


def hold_exit() -> Callable[[int], None]:
    """Let no library end this process as if its work were done. Returns what tells that it is.

    A simulator in C that calls exit(0) does so behind Python's back; now it comes with a line and
    exit code 1. C calls what is registered last first, so the code that is told at the end counts.
    """
    process, library = os.getpid(), ctypes.CDLL(None)
    register: Any = getattr(library, "__cxa_atexit", None)
    if register is None:
        return lambda code: None
    register.argtypes = [ctypes.c_void_p] * 3

    @ctypes.CFUNCTYPE(None, ctypes.c_void_p)
    def refuse(_: object) -> None:
        if os.getpid() == process:  # not in a child that a task has forked
            os.write(2, b"pacesetter: stopped: a library in C, such as a simulator, has exited\n")
            _exit(1)

    register(ctypes.cast(refuse, ctypes.c_void_p), None, None)
    _kept_for_c.append(refuse)

    def done(code: int) -> None:
        library.fflush(None)
        register(ctypes.cast(library._exit, ctypes.c_void_p), code, None)

    return done


def is_signal(error: BaseException) -> bool:
    """Whether a signal raised this, not code that raises KeyboardInterrupt by itself."""
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, Interrupted) or (isinstance(error, KeyboardInterrupt) and raises)


def on_signals(handler: Handler) -> None:
    """Let this handler have every signal that asks for the end."""
    _install(dict.fromkeys(CODES, handler))


def multiplies_bfloat16() -> bool:
    """Whether this processor has instructions for products of bfloat16, as Linux tells it."""
    try:
        words = Path("/proc/cpuinfo").read_text("utf-8").split()
    except OSError:
        return False
    return not {"avx512_bf16", "amx_bf16", "bf16"}.isdisjoint(words)


def _install(handlers: dict[int, Any]) -> dict[int, Any]:
    """Install handlers; what was there before. A hangup that `nohup` ignores stays ignored."""
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        handlers = {number: each for number, each in handlers.items() if number != signal.SIGHUP}
    return {number: signal.signal(number, each) for number, each in handlers.items()}


@contextmanager
def stopping(
    stop: Callable[[], object], abandon: Callable[[], object] = lambda: None
) -> Generator[list[int]]:
    """Let the first signal call `stop`, for a clean end; the second calls `abandon` and ends.

    Yields the list of signals received so far.
    """
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        if received:
            abandon()
            _exit(CODES[number])
        received.append(number)
        stop()

    before = _install(dict.fromkeys(CODES, handle))
    try:
        yield received
    finally:
        _install(before)


def exit_code(received: list[int]) -> int:
    """The code of a command that saved and ended on a signal: 130 after Ctrl-C, for example."""
    return CODES[received[0]]

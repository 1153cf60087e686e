"""Experiments on a process that trains: killed, or sent a signal, at random moments."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from attempts import Tally, command, patched
from short_runs import assert_same
from stopping import RING, kill_and_resume, litter, only_run, training, wait_for

from pacesetter import storage
from pacesetter.errors import UsageError
from pacesetter.process import CODES
from pacesetter.replay import buffer
from pacesetter.runs import find_all

SIZES = ["--hidden", "16", "16", "--batch-size", "16", "--warmup", "200", "--replay-size", "300"]
FLAGS = [*SIZES, "--eval-episodes", "1", "--eval-every", "2000", "--checkpoint-every", "0.5s", "-q"]
WORDS = ["train", "multi-td3", "Pendulum-v1", "--members", "4", *FLAGS]
AFTER = 2_000  # steps that a run makes after the last kill
GONE = 10.0  # seconds within which a process must have ended
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


def kills(folder: Path, count: int, seed: int = 0) -> Tally:
    """One run of four learners, killed so often, that must end as one that nobody killed."""
    tally = Tally()
    with ExitStack() as stack:
        for name, value in RING.items():
            stack.enter_context(patched(buffer, name, value))
        try:
            words = [*WORDS, "--steps", "10M"]
            killed = kill_and_resume(words, folder, kills=count, seed=seed, more=AFTER)
            words = [*WORDS, "--steps", str(killed.settings()["steps"])]
            command(*words, "--runs", folder / "whole")()
            assert_same(only_run(folder / "whole"), killed)
        except AssertionError as error:
            tally.wrong.append(f"kills: {error!s:.200}")
    tally.made = count
    return tally


def signals(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many runs, each sent one signal: half from the first instruction on, half in training."""
    rng, tally = random.Random(seed), Tally()
    for each in SIGNALS:  # a child would inherit what nohup or a shell makes this process ignore
        if signal.getsignal(each) is signal.SIG_IGN:
            signal.signal(each, signal.SIG_DFL)
    for number in range(count):
        runs, sent = folder / str(number), SIGNALS[number % len(SIGNALS)]
        words = [*WORDS, "--steps", "1M", "--runs", str(runs)]
        process = subprocess.Popen(
            [sys.executable, "-m", "pacesetter", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=dict(os.environ),
        )
        if in_training := number // len(SIGNALS) % 2 == 1:
            wait_for(partial(training, runs), process)
        moment = rng.uniform(0, 1) if in_training else rng.uniform(0.05, 3)
        time.sleep(moment)
        begun = _handles_signals(process.pid)
        process.send_signal(sent)
        when = f"{sent.name} {moment:.1f} s after {'saving' if in_training else 'its start'}"
        began = time.monotonic()
        try:
            _, err = process.communicate(timeout=GONE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            tally.wrong.append(f"{when}: not gone in {GONE:.0f} s")
            continue
        finally:
            tally.made += 1
        tally.slowest = max(tally.slowest, time.monotonic() - began)
        if not begun:
            tally.values["early"] = tally.values.get("early", 0) + 1
            # Python ends by the signal, or while it starts up by a traceback of its own.
            by_signal = process.returncode in (-sent, CODES[sent]) or "KeyboardInterrupt" in err
            fault = "" if by_signal and not runs.exists() else f"exit {process.returncode}: {err!r}"
        else:
            fault = _fault(process.returncode, sent, err, runs)
        if fault:
            tally.wrong.append(f"{when}: {fault}")
        shutil.rmtree(runs, ignore_errors=True)
    return tally


def signals_told(tally: Tally) -> str:
    """As the table tells it."""
    early = f"of which {tally.values.get('early', 0):.0f} before the program's first instruction"
    return f"{tally.made:,} made, {early}; {tally.of_processes().partition(', ')[2]}"


def _handles_signals(process: int) -> bool:
    """Whether the program has begun; before, Python starts up and answers signals by itself."""
    status = Path(f"/proc/{process}/status").read_text()
    (caught,) = re.findall(r"SigCgt:\s*(\w+)", status)
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def _fault(code: int, sent: signal.Signals, err: str, runs: Path) -> str:
    if code != CODES[sent]:
        return f"exit {code}, not {CODES[sent]}: {err[-200:]!r}"
    if "Traceback" in err:
        return f"traceback: {err[-200:]!r}"
    for run in find_all(runs):
        try:
            storage.read(run.state_file, "checkpoint")
        except UsageError as error:
            return f"nothing was saved: {error}"
        if litter(run) or run.in_use():
            return "litter or a lock is left"
    return ""

"""Experiments on a process that trains: killed, or sent a signal, at random moments."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from attempts import Tally, patched
from short_runs import assert_same
from stopping import RING, kill_and_resume, litter, only_run

from pacesetter import storage
from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.process import CODES
from pacesetter.replay import buffer
from pacesetter.runs import find_all

SIZES = ["--hidden", "16", "16", "--batch-size", "16", "--warmup", "200", "--replay-size", "300"]
FLAGS = [*SIZES, "--eval-episodes", "1", "--eval-every", "2000", "--checkpoint-every", "0.5s", "-q"]
WORDS = ["train", "multi-td3", "Hopper-v5", "--members", "4", *FLAGS]
GONE = 10.0  # seconds within which a process must have ended
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


def kills(folder: Path, count: int, seed: int = 0) -> Tally:
    """One run of four learners, killed so often, that must end as one that nobody killed."""
    tally = Tally()
    words = [*WORDS, "--steps", str(max(20_000, 3_000 * count))]
    with ExitStack() as stack:
        for name, value in RING.items():
            stack.enter_context(patched(buffer, name, value))
        try:
            killed = kill_and_resume(words, folder, kills=count, seed=seed)
            assert main([*words, "--runs", str(folder / "whole")]) == 0
            assert_same(only_run(folder / "whole"), killed)
        except AssertionError as error:
            tally.wrong.append(f"kills: {error!s:.200}")
    tally.made = count
    return tally


def signals(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many runs, each sent one signal at a moment from its first instruction on."""
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
        moment = rng.uniform(0.05, 12)
        time.sleep(moment)
        process.send_signal(sent)
        began = time.monotonic()
        try:
            _, err = process.communicate(timeout=GONE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            tally.wrong.append(f"{sent.name} after {moment:.1f} s: not gone in {GONE:.0f} s")
            continue
        finally:
            tally.made += 1
        tally.slowest = max(tally.slowest, time.monotonic() - began)
        if fault := _fault(process.returncode, sent, err, runs):
            tally.wrong.append(f"{sent.name} after {moment:.1f} s: {fault}")
    return tally


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

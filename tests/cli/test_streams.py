"""Output that nobody reads stops nothing and is no success; an answer is alone on stdout."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from pacesetter.cli.main import main
from pacesetter.cli.streams import UNREAD, Stream
from pacesetter.runs import RunDirectory
from pacesetter.storage import as_json

LOUD = """
import gymnasium, numpy, os

class Loud(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        print("a task speaks")
        return numpy.zeros(2, numpy.float32), {}

    def step(self, action):
        print("a step")
        self.count += 1
        return numpy.zeros(2, numpy.float32), 1.0, False, self.count == 20, {}

gymnasium.register("Loud-v0", entry_point=Loud)
"""
SMALL = ["--hidden", "8", "8", "--batch-size", "8", "--warmup", "10", "--replay-size", "100"]
SMALL += ["--steps", "60", "--eval-every", "20", "--eval-episodes", "1"]
TRAIN = ["train", "td3", "loud:Loud-v0", *SMALL]
COMMAND = [sys.executable, "-m", "pacesetter"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run in a folder that has the task and nothing else."""
    (tmp_path / "loud.py").write_text(LOUD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def finished() -> bool:
    (config,) = Path("runs").rglob("config.json")
    return RunDirectory(config.parent).rows("eval")[-1]["step"] == 60


def test_a_stream_without_a_reader() -> None:
    """What is written is dropped, nothing is raised, and it is known."""
    reader, writer = os.pipe()
    stream = Stream(writer)
    assert stream.write(b"one") == 3
    assert not stream.lost
    os.close(reader)
    for _ in range(2):
        assert stream.write(b"two") == 3
        assert stream.lost
    os.write(writer, b"what others write there is dropped too")
    os.close(writer)


def test_a_stream_on_a_full_disk() -> None:
    with open("/dev/full", "wb", buffering=0) as file:
        stream = Stream(os.dup(file.fileno()))
    assert stream.write(b"one") == 3
    assert stream.lost
    os.close(stream.fileno())


def test_a_slow_reader_misses_nothing() -> None:
    """Not even where the descriptor does not block."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    sent, got = os.urandom(300_000), bytearray()

    def read() -> None:
        while len(got) < len(sent):
            time.sleep(0.001)
            got.extend(os.read(reader, 50_000))

    thread = threading.Thread(target=read)
    thread.start()
    stream, left = Stream(writer), memoryview(sent)
    while left:
        left = left[stream.write(left) :]
    thread.join(timeout=10)
    assert (bytes(got), stream.lost) == (sent, False)
    os.close(reader)
    os.close(writer)


GUARD = """
import os, sys
from pacesetter.cli.streams import aside, guard
answer = guard()
os.write(1, b"a simulator speaks\\n")
with aside():
    print("a task speaks")
print("the answer \\udcff")
sys.stdout.flush()
print(answer.lost, open("mine", "w").fileno() > 2, file=sys.stderr, flush=True)
"""
SPOKEN = "a simulator speaks\na task speaks\n"


@pytest.mark.parametrize(
    ("how", "out", "err"),
    [
        ("", "the answer \\udcff\n", f"{SPOKEN}False True\n"),
        (">&-", "", f"{SPOKEN}True True\n"),
        (">/dev/full", "", f"{SPOKEN}True True\n"),
        ("2>&-", "the answer \\udcff\n", ""),
        ("<&-", "the answer \\udcff\n", f"{SPOKEN}False True\n"),
    ],
)
def test_only_the_answer_is_on_stdout(how: str, out: str, err: str) -> None:
    """And a closed descriptor is never that of a file which the command opens."""
    words = ["bash", "-c", f'exec "$@" {how}', "-", sys.executable, "-c", GUARD]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (0, out, err)


def test_training_goes_on_when_nobody_reads() -> None:
    """As after `2>&1 | head -1`; that its last words were lost is told by the exit code."""
    reader, writer = os.pipe()
    process = subprocess.Popen([*COMMAND, *TRAIN], stdout=writer, stderr=writer)
    os.close(writer)
    os.read(reader, 1)
    os.close(reader)
    assert process.wait(timeout=60) == UNREAD
    assert finished()


def test_training_goes_on_without_stderr() -> None:
    """Its answer is read, so all is well."""
    words = ["bash", "-c", 'exec "$@" 2>&-', "-", *COMMAND, *TRAIN]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 0
    assert done.stdout.startswith("loud:Loud-v0 td3 seed 0: 60 steps, return 20.0 at step 60\n")
    assert "speaks" not in done.stdout
    assert finished()


def test_json_is_json_whatever_a_task_prints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*TRAIN, "-q"]) == 0
    capsys.readouterr()
    for words in (["eval", "td3/0", "--episodes", "1", "--json"], ["show", "td3/0", "--json"]):
        assert main(words) == 0
        printed = capsys.readouterr()
        assert isinstance(json.loads(printed.out), dict)
        assert ("a task speaks" in printed.err) == (words[0] == "eval")


def refuse(word: str) -> Any:
    raise AssertionError(word)


def test_json_has_no_number_that_json_has_not() -> None:
    """Which a strict reader refuses; old files that have some are read as ever."""
    nan, inf = float("nan"), float("inf")
    text = as_json({"a": [1.5, nan, (inf, -inf)], "b": {"c": nan}, "d": "NaN"})
    found = json.loads(text, parse_constant=refuse)
    assert found == {"a": [1.5, None, [None, None]], "b": {"c": None}, "d": "NaN"}


def test_rows_of_the_log_are_strict(here: Path) -> None:
    directory = RunDirectory(here)
    directory.log.append({"kind": "train", "step": 0, "loss": float("nan")})
    text = directory.metrics_file.read_text()
    assert json.loads(text, parse_constant=refuse) == {"kind": "train", "step": 0, "loss": None}
    directory.metrics_file.write_text('{"kind": "train", "step": 0, "loss": NaN}\n')
    (old,) = directory.rows()
    assert old["loss"] != old["loss"]

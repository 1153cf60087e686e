"""docs/features.md: each of the 79 rows once, with a verdict, and verbs and flags that exist."""

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from pacesetter.cli.main import VERBS, main

PAGE = (Path(__file__).parents[2] / "docs" / "features.md").read_text()
ROWS = re.findall(r"^\| (\d+) \| ([^|]+) \| ([^|]+) \|(.*)\|$", PAGE, re.MULTILINE)


def test_every_row_once_with_a_verdict() -> None:
    assert sorted(int(number) for number, *_ in ROWS) == [*range(1, 80)]
    for number, _, verdict, _ in ROWS:
        assert verdict in {"yes", "partly", "no", "no, on purpose"}, number


def test_counts_are_those_of_the_rows() -> None:
    """The page says how many of the first 39 rows, and of the 40 others, have each verdict."""
    old, new = (
        Counter(verdict for number, _, verdict, _ in ROWS if (int(number) < 40) == is_old)
        for is_old in (True, False)
    )
    (said,) = re.findall(r"^Of the 39 .*?purpose\.$", PAGE, re.MULTILINE | re.DOTALL)
    numbers = [int(number) for number in re.findall(r"\d+", re.sub(r"\(.*?\)", "", said))]
    assert numbers[:3] == [39, old["yes"], old["partly"]]
    assert numbers[3:] == [40, *(new[kind] for kind in ("yes", "partly", "no", "no, on purpose"))]


def test_commands_have_verbs_and_flags_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    known = {*re.findall(r"--[a-z][\w.-]*", capsys.readouterr().out), "--help"}
    found = re.findall(r"`((?:pacesetter|--)[^`]+)`", PAGE)
    assert len(found) > 40
    for code in found:
        first, *words = code.split()
        assert first.startswith("--") or words[0] in VERBS, code
        flags = {word for word in (first, *words) if re.match(r"--(?!env\.)", word)}
        assert flags <= known, code


SHORT = "--steps 400 --warmup 100 --hidden 16 16 --eval-every 200 --eval-episodes 1"  # the page's S
# What only a person at a display, a network or another machine can try, or other tests do.
LEFT_OUT = re.compile(
    r"pip|pytest|make|docker|jupyter|uvx? |.*(watch|push|fetch|live|FILE\.toml|shimmy)"
)
REFUSED = {50: 2, 59: 2, 61: 2}  # what the last command of these rows is to end with


def commands() -> dict[int, list[str]]:
    """Of each row, the commands that a shell can run, with the page's words filled in."""
    found: dict[int, list[str]] = {}
    for number, _, verdict, cell in ROWS:
        codes = re.findall(r"`([^`]+)`", cell)
        lines = [code for code in codes if re.match(r"(PYTHONPATH=\S+ )?[a-z]+ [^|]+", code)]
        lines = [re.sub(r"\bS\b", SHORT, line) for line in lines if not LEFT_OUT.match(line)]
        if (verdict in ("yes", "partly") or int(number) in REFUSED) and lines:
            found[int(number)] = [line.replace("RUN", "Pendulum-v1/td3/0") for line in lines]
    del found[10]  # a million steps on a terminal
    first = {number: found.pop(number) for number in (1, 14)}  # the runs that others name
    return first | found


def test_every_row_that_is_here_has_something_to_try() -> None:
    bare = [number for number, _, verdict, cell in ROWS if verdict == "yes" and "`" not in cell]
    assert bare == []
    assert len(commands()) > 40


@pytest.mark.slow
def test_every_command_does_what_it_should(tmp_path: Path) -> None:
    """In a folder that has what a clone has; the runs of rows 1 and 14 come first."""
    root = Path(__file__).parents[2]
    for path in root.iterdir():
        if path.name in {"examples", "results", "docs"} or path.suffix in {".md", ".cff"}:
            (tmp_path / path.name).symlink_to(path)
    programs = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    offline = {"WANDB_MODE": "offline", "TRACKIO_DIR": str(tmp_path / "trackio")}
    wrong: list[str] = []
    for number, lines in commands().items():
        for line in lines:
            done = subprocess.run(
                line, shell=True, cwd=tmp_path, env=os.environ | programs | offline,
                capture_output=True, text=True,
            )  # fmt: skip
            wanted = REFUSED.get(number, 0) if line == lines[-1] else 0
            if done.returncode != wanted:
                wrong.append(f"row {number}: `{line}` gave {done.returncode}: {done.stderr[-300:]}")
    assert not wrong, "\n".join(wrong)

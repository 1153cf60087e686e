"""docs/features.md: each of the 79 rows once, with a verdict, and verbs and flags that exist."""

import re
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

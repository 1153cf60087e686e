"""The short form of every experiment; `make torture` and `make torture-long` run the long ones."""

from datetime import date
from pathlib import Path

import configurations
import crowds
import disk_full
import exactness
import faults
import memory
import odd_files
import page
import power_cuts
import processes
import pytest
import rude
import sameness
import swapped
from attempts import Tally, attempt, command


@pytest.mark.filterwarnings(
    "default",  # as in a command
    "ignore:overflow encountered in matmul:RuntimeWarning",  # of weights that were made huge
    "ignore:invalid value encountered in matmul:RuntimeWarning",
)
def test_odd_files(tmp_path: Path) -> None:
    tally = odd_files.run(tmp_path, odd_files.KINDS, each=8, seed=5)
    assert tally.wrong == []
    assert tally.made == 8 * len(odd_files.KINDS)
    assert tally.refused > tally.made / 4


@pytest.mark.filterwarnings("default")
def test_configurations(tmp_path: Path) -> None:
    tally = configurations.run(tmp_path, 60, seed=6)
    assert tally.wrong == []
    assert 20 < tally.refused < tally.made == 60  # some are fine


@pytest.mark.filterwarnings("default")
def test_files_that_are_no_longer_what_they_were(tmp_path: Path) -> None:
    tally = swapped.run(tmp_path, 15, seed=5)
    assert tally.wrong == []
    assert 0 < tally.refused < tally.made == 15


def test_a_signal_at_any_moment(tmp_path: Path) -> None:
    assert processes.signals(tmp_path, 1, seed=5).wrong == []


def test_a_number_that_is_none(tmp_path: Path) -> None:
    tally = faults.run(tmp_path, 4, seed=5)
    assert (tally.made, tally.wrong) == (4, [])


def test_many_want_one_run(tmp_path: Path) -> None:
    tally = crowds.run(tmp_path, 1, seed=5, size=4)
    assert (tally.made, tally.wrong) == (1, [])


def test_a_full_disk(tmp_path: Path) -> None:
    tally = disk_full.run(tmp_path, 1, seed=3, make=disk_full.Limited)
    assert tally.wrong == []
    assert tally.refused > 0


def test_what_was_not_synced_is_lost(tmp_path: Path) -> None:
    tally = power_cuts.run(tmp_path, 5, seed=5)
    assert (tally.made, tally.wrong) == (5, [])


@pytest.mark.parametrize("way", ["ExitsInC", "Prints"])
def test_a_rude_task(way: str, tmp_path: Path) -> None:
    assert rude.Trial(way, "train", tmp_path / "0", 200).fault() == ""


def test_one_seed_is_one_run(tmp_path: Path) -> None:
    tally = sameness.run(tmp_path, 1, seed=5)
    assert (tally.made, tally.wrong) == (1, [])


def test_a_leak_is_seen(tmp_path: Path) -> None:
    """And a few trainings give back what they took."""
    tally = memory.run(tmp_path, 3, leak=60_000)  # 5,700 MB; what the heap has free hides some
    (leak,) = tally.wrong
    assert "MB more in 100,000 steps" in leak
    assert 1_000 < tally.values["slope"] < 6_000
    assert tally.values["trainings"] == 5


def test_disturbed_and_exact(tmp_path: Path) -> None:
    """Of one algorithm; tests/training has the others, stopped within one process."""
    tally = exactness.run(tmp_path, 1, seed=5, points=2)
    assert (tally.made, tally.wrong) == (2, [])


def test_an_attempt_sees_what_goes_wrong(tmp_path: Path) -> None:
    """A check that cannot fail would prove nothing."""
    tally = Tally()

    def fail() -> None:
        raise KeyError("x")

    def run_code() -> None:
        import intruder  # pyright: ignore[reportMissingImports]

        assert intruder

    attempt(tally, "a fault", fail)
    attempt(tally, "an import", run_code)
    attempt(tally, "a refusal", command("show", tmp_path / "nothing"))
    attempt(tally, "a success", command("--version"))
    assert [each.split(":")[1] for each in tally.wrong] == [" traceback", " code run"]
    assert (tally.made, tally.refused) == (4, 1)


def test_a_new_row_leaves_the_others(tmp_path: Path) -> None:
    """Rows of experiments that are no more go; what stands around the table stays."""
    file = tmp_path / "page.md"
    rows = ["| a | 0 | 1 | yes | 2026-01-01 |", "| old | 0 | 1 | yes | 2026-01-01 |"]
    file.write_text("\n".join(["# Page", page.BEGIN, *page.HEAD, *rows, page.END, "after"]))
    page.write(file, page.row("b", "0", "2", met=False), order=["b", "c", "a"])
    before, table = file.read_text().split(page.BEGIN)
    table, after = table.split(page.END)
    assert (before, after) == ("# Page\n", "\nafter")
    new, kept = table.strip().splitlines()[2:]
    assert new == f"| b | 0 | 2 | NO | {date.today()} |"
    assert kept == rows[0]

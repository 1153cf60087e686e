"""The short form of every experiment; `make torture` and `make torture-long` run the long ones."""

from pathlib import Path

import odd_files
import pytest
from attempts import Tally, attempt, command


@pytest.mark.filterwarnings("default")  # as in a command; NumPy warns where it is used in tests
def test_odd_files(tmp_path: Path) -> None:
    tally = odd_files.run(tmp_path, odd_files.KINDS, each=12, seed=5)
    assert tally.wrong == []
    assert tally.made == 12 * len(odd_files.KINDS)
    assert tally.refused > tally.made / 4


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

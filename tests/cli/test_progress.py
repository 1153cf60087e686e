"""Speed and time left, of which both displays make their lines."""

import pytest

from pacesetter.cli.progress import Pace, bars


def test_pace_is_that_of_the_last_looks() -> None:
    """Ten steps per second at first, then two: the first look is forgotten after three more."""
    pace = Pace(0, 0.0, looks=3)
    assert pace.read(0, 5.0, 100) == (0.0, "-")  # nothing yet
    pace = Pace(0, 0.0, looks=3)
    assert pace.read(10, 1.0, 100) == (10.0, "0:00:09")
    assert pace.read(12, 2.0, 100)[0] == pytest.approx(6.0)
    assert pace.read(14, 3.0, 100) == (2.0, "0:00:43")


def test_a_limit_of_time_ends_before_the_steps() -> None:
    pace = Pace(100, 60.0, looks=10)
    assert pace.read(200, 70.0, 10_000, most=30.0) == (10.0, "0:00:30")
    assert pace.read(300, 120.0, 10_000, most=-5.0)[1] == "0:00:00"


@pytest.mark.parametrize("width", [60, 80, 200])
def test_a_narrow_terminal_cuts_nothing(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bar shrinks; name, count and the note, which wraps, stay whole."""
    monkeypatch.setenv("COLUMNS", str(width))
    note = "training  0:00:04 elapsed  ETA 0:10:00  926.0 steps/s\nreturn 10.0  in training 1 | 2"
    with bars() as shown:
        shown.add_task("HalfCheetah-v5 multi-td3 0", total=1_000_000, completed=20_000, below=note)
        with shown.console.capture() as captured:
            shown.console.print(shown.get_renderable())
    lines = captured.get().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    text = " ".join(captured.get().split())
    for part in ("HalfCheetah-v5 multi-td3 0", "20,000/1,000,000", *note.split()):
        assert part in text
    assert "…" not in text

"""What a newcomer is told before hours are spent: a budget within the warm-up, a run of days."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pacesetter.cli.advice import Slowness, within_warmup
from pacesetter.cli.main import main
from pacesetter.cli.progress import View
from pacesetter.config import resolve

TASK = "Pendulum-v1"
FLAGS = ["--eval-every", "100", "--eval-episodes", "1"]


def test_a_budget_within_the_warmup_is_said_before_it_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "td3", TASK, "--steps", "100", "--runs", str(tmp_path), *FLAGS]) == 0
    first = capsys.readouterr().err.splitlines()[0]
    assert "the run has 100 steps and acts at random for the first 25,000, so" in first
    assert "--warmup 10" in first


@pytest.mark.parametrize(
    "settings", [{"steps": 26_000}, {"steps": 500, "warmup": 100}, {"warmup_updates": True}]
)
def test_a_budget_that_learns_is_no_matter(settings: dict[str, Any]) -> None:
    assert within_warmup(resolve("td3", TASK, {"steps": 1_000} | settings)) is None


def test_members_count_together() -> None:
    """As many steps per member as the warm-up is long in all are enough for two."""
    counted = {"steps": 13_000, "members": 2, "count": "member"}
    assert within_warmup(resolve("td3", TASK, counted)) is None
    assert within_warmup(resolve("td3", TASK, counted | {"count": "all"})) is not None


class Clockwork:
    """A trainer whose updates come at a speed."""

    def __init__(self, name: str, speed: float, **settings: Any) -> None:
        self.config = resolve(name, TASK, settings)
        self.budget, self.speed = self.config.budget, speed
        self.progress: Any = SimpleNamespace(step=5_000, updates=0, wall_seconds=0.0)

    def lines(self, seconds: int) -> list[str]:
        slow, said = Slowness(self), []  # pyright: ignore
        for now in range(seconds):
            self.progress.updates = int(now * self.speed)
            said.append(slow.look(float(now)))
        return [line for line in said if line]


def test_a_run_of_days_is_said_once() -> None:
    """A million updates at 2 per second are 5.8 days; the small preset is named."""
    (line,) = Clockwork("crossq", 2.0).lines(200)
    assert "2 updates per second" in line
    assert "about 5.8 days" in line
    assert "train crossq-small instead" in line
    assert "--critic-hidden 256 256" in line


def test_updates_in_the_warmup_count() -> None:
    """A run whose every step is one of the warm-up makes its updates all the same."""
    steps: dict[str, Any] = {"steps": 1_000_000, "warmup": 1_000_000}
    assert Clockwork("crossq", 2.0, **steps).lines(200) == []
    (line,) = Clockwork("crossq", 2.0, **steps, warmup_updates=True).lines(200)
    assert "about 5.8 days" in line


def test_a_run_of_hours_is_not() -> None:
    assert Clockwork("crossq", 100.0).lines(200) == []
    assert Clockwork("crossq", 6.0).lines(200) != []
    assert Clockwork("crossq", 6.0, time="8h").lines(200) == [], "its length is known"


def test_settings_too_slow_for_the_machine_are_said_however_short_the_run() -> None:
    """Default crossq on two busy cores made 171 updates in 9 minutes, and nothing was said."""
    (line,) = Clockwork("crossq", 171 / 540, steps=7_000).lines(200)
    assert "0.32 updates per second" in line
    assert "about 1.7 hours" in line, "2,000 steps are left, one update each"
    assert "train crossq-small instead" in line
    (line,) = Clockwork("crossq", 0.5, steps=5_500).lines(200)
    assert "about 17 minutes" in line
    assert Clockwork("crossq", 0.5, steps=5_200).lines(200) == [], "seven minutes are borne"
    assert Clockwork("crossq", 6.0, steps=20_000).lines(200) == [], "42 minutes of a usual speed"


def test_a_limit_of_time_does_not_make_slow_settings_bearable() -> None:
    """Half an hour of crossq at 0.3 updates per second would be 540 updates."""
    (line,) = Clockwork("crossq", 0.3, time="30m").lines(200)
    assert "and --time ends it after 30 minutes" in line
    assert "such as --time" not in line
    assert Clockwork("crossq", 0.3, time="5m").lines(200) == [], "five minutes are borne"
    resumed = Clockwork("crossq", 0.3, time="8h")
    resumed.progress.wall_seconds = 7.5 * 3600
    assert "--time ends it after 30 minutes" in resumed.lines(200)[0], "what was spent counts"
    resumed.progress.wall_seconds = 7.95 * 3600
    assert resumed.lines(200) == [], "three minutes are borne"


def test_bench_says_it_of_each_entry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "--algos", "td3", "ddpg", "--envs", TASK, "--seeds", "2", "--steps", "50",
             "--jobs", "1", "--runs", str(tmp_path), *FLAGS]  # fmt: skip
    assert main(words) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "warm-up" in line]
    assert [line.split(":")[1] for line in lines] == [f" {TASK} td3", f" {TASK} ddpg"]
    assert main([*words, "--quiet", "--runs", str(tmp_path / "quiet")]) == 0
    assert "warm-up" not in capsys.readouterr().err


def test_a_resumed_run_knows_its_best() -> None:
    trainer: Any = Clockwork("td3", 1.0, steps=30_000)
    trainer.progress = SimpleNamespace(
        step=6_000, next_evaluation=10_000, wall_seconds=0.0, ended=[], best=12.5
    )
    assert View(trainer).returns() == "return - (best 12.5)"
    assert View(trainer).speed().endswith("  - steps/s"), "no step was seen yet"


def test_the_view_names_the_phase() -> None:
    trainer: Any = Clockwork("td3", 1.0, steps=30_000)
    trainer.progress = SimpleNamespace(
        step=100, next_evaluation=5_000, wall_seconds=0.0, ended=[[1, -7.5, 200]], best=None
    )
    view = View(trainer)
    assert (view.phase, "ETA after the warm-up" in view.speed()) == ("warm-up", True)
    assert view.returns() == "return - (best -)  in training -7.5"
    trainer.progress.step = 26_000
    trainer.progress.next_evaluation = 30_000
    assert view.phase == "training"
    trainer.progress.next_evaluation = 26_000
    assert view.phase == "evaluating"


def test_blocks_of_updates_that_never_come() -> None:
    """Steps after the warm-up that fill no block are not learned from either."""
    blocks = {"steps": 199, "warmup": 100, "update_every": 100}
    told = within_warmup(resolve("td3", TASK, blocks))
    assert told is not None
    assert "less than a block of 100" in told
    assert within_warmup(resolve("td3", TASK, blocks | {"steps": 200})) is None

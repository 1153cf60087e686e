"""The balloon of the how-to: its physics, its API, and what it pays for."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import balloon
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pacesetter.cli.main import main
from pacesetter.runs import RunDirectory

EXAMPLE = Path(balloon.__file__)
TINY = "--steps 300 --warmup 100 --hidden 8 --batch-size 8 --eval-every 300 --eval-episodes 1 -q"


@pytest.fixture
def aloft() -> Any:
    """A balloon with a known wind: 4 m/s per km, calm at 1.5 km."""
    env = balloon.Balloon(power_cost=0.3)
    env.reset(seed=0)
    env.shear, env.calm = 4.0, 1.5
    env.distance, env.altitude, env.climb = 1.0, 1.0, 0.0
    return env


def test_a_minute_at_full_power(aloft: Any) -> None:
    """By hand: the climb rate goes half of the way to 2 m/s, so 60 m up; wind 4 (1.06 - 1.5)."""
    observation, reward, terminated, truncated, info = aloft.step(np.array([1.0], np.float32))
    distance = 1.0 - 1.76 * 60 / 1000
    winds = [-1.76, 4 * (0.5 - 1.5), 4 * (2.5 - 1.5)]
    np.testing.assert_allclose(observation, [distance, 1.06, 1.0, *winds], rtol=1e-12)
    assert reward == pytest.approx(np.exp(-((distance / 2) ** 2)) - 0.3, rel=1e-12)
    assert info["reward_place"] + info["reward_power"] == pytest.approx(reward, rel=1e-12)
    assert not terminated
    assert not truncated


@pytest.mark.parametrize(("altitude", "power"), [(0.05, -1.0), (2.95, 1.0)])
def test_ground_and_ceiling_end_the_task(aloft: Any, altitude: float, power: float) -> None:
    aloft.altitude = altitude
    assert aloft.step(np.array([power]))[2]


def test_the_step_limit_truncates() -> None:
    env = gymnasium.make("Balloon-v0")
    env.reset(seed=3)
    ends = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(balloon.STEPS)]
    assert ends == [(False, False)] * (balloon.STEPS - 1) + [(False, True)]


def test_gymnasium_accepts_it() -> None:
    check_env(gymnasium.make("Balloon-v0").unwrapped, skip_render_check=True)


def test_holding_its_place_pays_and_power_costs() -> None:
    """The pilot beats rest on the same 20 episodes, and rest beats full power upwards."""
    pilot = balloon.score(balloon.pilot, 20)[0]
    rest = balloon.score(lambda observation: np.zeros(1), 20)[0]
    up = balloon.score(lambda observation: np.ones(1), 20)[0]
    assert pilot > 150 > rest > up
    assert pilot < balloon.STEPS


def test_command_line_trains_on_it_and_the_example_scores_the_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the how-to does: train by module and id, with a keyword, then compare."""
    monkeypatch.chdir(tmp_path)
    words = ["train", "td3", "balloon:Balloon-v0", "--env.power_cost", "0.1", *TINY.split()]
    assert main(words) == 0
    run = RunDirectory(tmp_path / "runs" / "balloon-Balloon-v0" / "td3" / "0")
    last = [row for row in run.rows() if row["kind"] == "eval"][-1]
    assert last["terms"].keys() == {"reward_place", "reward_power"}
    assert sum(last["terms"].values()) == pytest.approx(last["mean"], rel=1e-6)
    command = [sys.executable, str(EXAMPLE), str(run.policy_file)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = result.stdout.splitlines()
    ends = ["random power", "no power", "pilot", str(run.policy_file)]
    assert [line.split("  ")[-1] for line in lines] == ends

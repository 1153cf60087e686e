"""Several envs per member: what is counted, who waits, and whose episode a row belongs to."""

from pathlib import Path

import numpy as np
import pytest
from scripted_runs import IDLE, start
from short_runs import TINY, log, run_to_end

from pacesetter.errors import UsageError
from pacesetter.training.trainer import Trainer


def test_steps_and_updates_are_counted_over_all_envs(runs: Path) -> None:
    """Episodes of 10, 20 and 30 steps in turn: nobody waits, and 1 update is made per env step."""
    returns = ([1], [2], [3])
    trainer = start(runs, returns, (10, 20, 30), "td3", num_envs=3, steps=180, batch_size=4)
    run_to_end(trainer)
    progress = trainer.progress
    assert progress.step == progress.members[0].steps == progress.updates == 180
    ended = [
        tuple(episode)
        for row in log(trainer.directory)
        if row["kind"] == "train"
        for episode in row["episodes_ended"]
    ]
    assert sorted(ended) == sorted([(0, 1, 10)] * 6 + [(0, 2, 20)] * 3 + [(0, 3, 30)] * 2)


def test_a_budget_is_met_to_the_step(runs: Path) -> None:
    trainer = start(runs, ([1], [2], [3]), (10, 20, 30), "td3", num_envs=3, steps=100, **IDLE)
    run_to_end(trainer)
    assert trainer.progress.step == 100
    assert [len(e.env.actions) for e in trainer.loop.explorers] == [4, 13, 3]


def test_a_round_ends_with_the_last_env_of_the_last_member(runs: Path) -> None:
    """Members 0 and 1 have envs 0, 2 and 1, 3; the longest episode has 20 steps."""
    returns = ([1], [2], [7], [4])
    settings = {"num_envs": 2, "steps": 4 * 20, "select_window": 2}
    trainer = start(runs, returns, (20, 10, 10, 10), **settings, **IDLE)
    rows = [row for row in log(run_to_end(trainer)) if row["kind"] == "select"]
    assert [(row["step"], row["returns"], row["parents"]) for row in rows] == [
        (50, [[7, 1], [2, 4]], [0, 0])
    ]


def test_rows_of_one_env_follow_one_another(runs: Path) -> None:
    """Row by row in turn: what a step leads to is where that env's next step begins."""
    trainer = start(runs, ([1], [2], [3]), (10, 20, 30), "td3", num_envs=3, steps=150, **IDLE)
    while trainer.progress.step < 150:
        trainer.loop.tick()
    layout, replay = trainer.loop.learners.compiled.layout, trainer.loop.replays[0]
    rows = layout.unpack(np.array(replay.rows[:150]))
    trainer.close()
    assert np.array_equal(rows.observation[:, 0], np.tile([0, 1, 2], 50))
    for mark, length in enumerate((10, 20, 30)):
        now, then = rows.observation[mark::3], rows.next_observation[mark::3]
        last = rows.last[mark::3].astype(bool)
        assert np.array_equal(np.flatnonzero(last), np.arange(length - 1, 50, length))
        assert np.array_equal(then[:-1][~last[:-1]], now[1:][~last[:-1]])


@pytest.mark.parametrize("envs", [0, 1001])
def test_refuses_numbers_out_of_range(runs: Path, envs: int) -> None:
    with pytest.raises(UsageError, match="num_envs: should be"):
        Trainer("td3", "Pendulum-v1", runs=runs, num_envs=envs, **TINY)


def test_refuses_assessed_policies(runs: Path) -> None:
    with pytest.raises(UsageError, match=r"num_envs: --assess judges .*; use --num-envs 1"):
        Trainer("td3", "Pendulum-v1", runs=runs, num_envs=2, assess=1, **TINY)

"""Several envs per member: what is counted, who waits, and whose episode a row belongs to."""

from pathlib import Path

import numpy as np
import pytest
from scripted_runs import IDLE, start
from short_runs import TINY, log, run_to_end

from pacesetter.config import resolve
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


def test_a_round_counts_whole_not_by_its_longest_episodes(runs: Path) -> None:
    """The last episode of member 0 is its longest and worst; by its mean, 4 against 3, it wins."""
    returns = ([1], [2], [7], [4])
    trainer = start(runs, returns, (20, 10, 10, 10), num_envs=2, steps=80, **IDLE)
    row = next(row for row in log(run_to_end(trainer)) if row["kind"] == "select")
    assert (row["returns"], row["parents"]) == ([[7, 1], [2, 4]], [0, 0])


def calls(trainer: Trainer) -> list[int]:
    """The steps that member 0 had made at each of its calls of the update."""
    found: list[int] = []
    make = trainer.loop.updates.make

    def watched(members: list[int]) -> None:
        found.extend(trainer.progress.members[0].steps for k in members if k == 0)
        make(members)

    trainer.loop.updates.make = watched
    run_to_end(trainer)
    return sorted(set(found))


def test_envs_that_wait_do_not_fill_a_block(runs: Path) -> None:
    """Blocks of 20 steps, in rounds of 43: 2 per tick, then 1 while the shorter env waits."""
    trainer = start(
        runs, ([1], [2], [3], [4]), (30, 30, 13, 30), num_envs=2, steps=240, update_every=20,
        batch_size=4,
    )  # fmt: skip
    assert calls(trainer) == [20, 40, 61, 80, 100]


def test_updates_at_the_end_of_an_episode_are_made_once_per_end(runs: Path) -> None:
    """Env 0 waits from step 20 to step 30 of its member's other env."""
    trainer = start(
        runs, ([1], [2], [3], [4]), (10, 20, 20, 20), num_envs=2, steps=120, batch_size=4,
        update_at="episode",
    )  # fmt: skip
    assert calls(trainer) == [20, 30, 50]


def test_refuses_blocks_that_no_member_fills() -> None:
    with pytest.raises(UsageError, match=r"update_every: .* 250 steps per member .* at most 250"):
        resolve("multi-td3", "Ant-v5", {"members": 4, "steps": 1000, "update_every": 500})

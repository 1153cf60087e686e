"""TD7's checkpoints: which policies are kept, when learning waits, and what evaluation uses."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numeric import same
from scripted_runs import IDLE, start
from short_runs import log, run_to_end

from pacesetter.ensemble.policy_checkpoint import Assessment
from pacesetter.policy import load
from pacesetter.training.trainer import Trainer


def judge(returns: list[float], most: int = 3, long_from: int = 0) -> list[bool | None]:
    assessment = Assessment()
    return [assessment.add(r, i >= long_from, most) for i, r in enumerate(returns)]


def test_a_policy_is_kept_for_its_worst_episode() -> None:
    """Three episodes each: worst 4; then 9, 3 is dropped at once; then worst 4 ties and wins."""
    assessment = Assessment()
    found = [assessment.add(r, True, 3) for r in (5, 4, 6, 9, 3, 8, 7, 4, 2)]
    assert found == [None, None, True, None, False, None, None, True, False]
    assert assessment.best == 4


def test_short_assessments_keep_every_better_policy() -> None:
    assert judge([3, 5, 4, 5, 6], long_from=99) == [True, True, False, True, True]


@pytest.mark.parametrize(("best", "lowered"), [(10.0, 9.0), (-10.0, -11.0), (0.0, 0.0)])
def test_the_bar_falls_once_when_assessments_become_long(best: float, lowered: float) -> None:
    """Also below zero, where TD7's factor would raise it."""
    assessment = Assessment()
    assessment.add(best, False, 2)
    assert assessment.add(lowered, True, 2) is None
    assert assessment.best == lowered
    assert assessment.add(lowered, True, 2) is True
    assert assessment.add(lowered - 0.1, True, 2) is False


def assessed(runs: Path, returns: Any, **settings: Any) -> Trainer:
    """One member by default, episodes of 10 steps, assessments of two."""
    options = {"assess": 2, "assess_after": 0, "algorithm": "td3", "eval_every": 10, **settings}
    return start(runs, returns=returns, **options)


def test_policy_is_fixed_while_it_is_assessed(runs: Path) -> None:
    """Returns 5, 4 (kept) and 3 (dropped) in turn: updates only after steps 20, 30, 50 and 60,
    and then all that fell due.
    """
    trainer = assessed(runs, ([5, 4, 3],), steps=60)
    before = jax.device_get(trainer.loop.learners.states[0])
    seen: list[tuple[int, int, bool]] = []
    for report in trainer:
        if report.kind == "eval":
            after = jax.device_get(trainer.loop.learners.states[0])
            seen.append((report.step, trainer.progress.updates, same(before, after)))
            before = after
    assert seen == [
        (0, 0, True),
        (10, 0, True),
        (20, 20, False),
        (30, 30, False),
        (40, 30, True),
        (50, 50, False),
        (60, 60, False),
    ]
    verdicts = [x for row in log(trainer.directory) for x in row.get("assessed", [])]
    assert verdicts == [[0, True], [0, False]] * 2


def test_the_kept_policy_is_what_is_evaluated(runs: Path) -> None:
    """The first assessment keeps the initial policy, no later one is as good; it outlives a stop
    and stands in the policy file with its step.
    """
    trainer = assessed(runs, ([9, 9, 1, 2, 3, 4],), steps=60)
    first = trainer.policy().act(np.ones(3))
    run_to_end(trainer)
    resumed = Trainer.resume(trainer.directory.path, steps=61)
    for policy in (trainer.policy(), load(trainer.directory.policy_file), resumed.policy()):
        np.testing.assert_array_equal(policy.act(np.ones(3)), first)
        assert (policy.about["kept_at"], policy.about["worst_return"]) == (20, 9)
    assert np.any(resumed.loop.current_policy(0).act(np.ones(3)) != first)
    resumed.close()


def test_warmup_episodes_assess_nobody(runs: Path) -> None:
    """Episodes of 10 with a warm-up of 15: the third is the first that counts."""
    trainer = assessed(runs, ([9, 9, 1, 1],), steps=40, warmup=15)
    run_to_end(trainer)
    policy = trainer.policy()
    assert (policy.about["kept_at"], policy.about["worst_return"]) == (40, 1)
    assert trainer.progress.updates == 24


def test_members_assess_themselves(runs: Path) -> None:
    """Without selection each keeps its own; a copy takes the parent's with it."""
    apart = assessed(runs, ([5, 5], [7, 7]), members=2, rule="none", steps=40, name="apart", **IDLE)
    run_to_end(apart)
    assert [policy.about["worst_return"] for policy in map(apart.loop.policy, (0, 1))] == [5, 7]
    copied = assessed(
        runs, ([5, 5], [7, 7]), algorithm="multi-td3", steps=40, name="copied", **IDLE
    )
    run_to_end(copied)
    for member in (0, 1):
        assert copied.loop.policy(member).about["worst_return"] == 7
        assert copied.loop.policy_checkpoints.assessments[member].best == 7


def test_many_updates_are_spread_over_ticks(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The env waits until all are made, and the run ends where one that makes them at once does."""
    monkeypatch.setattr("pacesetter.ensemble.members.MAX_CALLS_PER_TICK", 3)
    spread = assessed(runs, ([5, 4, 3],), steps=61, name="spread", eval_every=1000)
    run_to_end(spread)
    assert spread.progress.updates == 60
    assert spread.progress.tick > 61
    assert [row["updates"] for row in spread.directory.rows("eval")] == [0, 60]
    saved, last = load(spread.directory.policy_file), spread.policy()
    assert np.array_equal(saved(np.ones(3)), last(np.ones(3)))
    monkeypatch.undo()
    again = assessed(runs, ([5, 4, 3],), steps=61, name="again", eval_every=1000)
    run_to_end(again)
    assert same(*(jax.device_get(t.loop.learners.states[0]) for t in (spread, again)))


def test_an_episode_that_another_policy_began_assesses_nobody(runs: Path) -> None:
    """Member 0 becomes a copy in the middle of its second episode; the third counts again."""
    trainer = assessed(runs, ([5], [4]), members=2, rule="none", assess=1, steps=120, **IDLE)
    for tick in range(30):
        if tick == 15:
            trainer.progress.members[0].copied = trainer.progress.step
        trainer.loop.tick()
    found = trainer.loop.training_values()["assessed"]
    trainer.close()
    assert [k for k, _ in found] == [0, 1, 1, 0, 1]


def test_a_mean_of_states_has_played_no_episode_yet(runs: Path) -> None:
    trainer = assessed(runs, ([5], [4]), members=2, rule="none", assess=3, steps=120, **IDLE)
    for _ in range(20):
        trainer.loop.tick()
    checkpoints, parents = trainer.loop.policy_checkpoints, np.array([0, 0])
    assert [each.returns for each in checkpoints.assessments] == [[5, 5], [4, 4]]
    checkpoints.copy(parents, averaged=False)
    assert [each.returns for each in checkpoints.assessments] == [[5, 5], [5, 5]]
    checkpoints.copy(parents, averaged=True)
    assert [each.returns for each in checkpoints.assessments] == [[], []]
    trainer.close()


def test_copies_that_come_more_often_than_episodes_end_do_not_stop_learning(runs: Path) -> None:
    """Everyone is averaged after each 10 own steps, in the middle of episodes of 25: no policy can
    be assessed, but the updates that wait are made when an episode ends.
    """
    trainer = assessed(
        runs, ([5], [7]), lengths=(25, 25), members=2, rule="average", select_on="eval",
        select_every=20, count_selection_steps=False, wait=False, steps=200,
    )  # fmt: skip
    run_to_end(trainer)
    assert not any(row.get("assessed") for row in log(trainer.directory))
    assert trainer.progress.updates == 200

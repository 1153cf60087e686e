"""Rows over several steps against their definition, and what becomes of them in a run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import TINY, run_to_end

from pacesetter.batch import Transition
from pacesetter.replay.n_step import NStepQueue
from pacesetter.training.trainer import Trainer

GAMMA = 0.9


def episode(rng: np.random.Generator, terminated: bool) -> list[Transition]:
    """A random episode, no two of whose numbers are alike."""
    length = int(rng.integers(1, 9))
    seen = rng.normal(size=(length + 1, 3)).astype(np.float32)
    rewards = rng.normal(size=length)
    return [
        Transition(
            seen[t],
            rng.normal(size=2).astype(np.float32),
            float(rewards[t]),
            seen[t + 1],
            GAMMA * (1.0 - (terminated and t == length - 1)),
            t == length - 1,
            rng.random(4).astype(np.float32),
            float(rewards[:t].sum()),
        )
        for t in range(length)
    ]


def by_definition(steps: list[Transition], n: int, terminated: bool) -> list[Transition]:
    rows: list[Transition] = []
    for t, first in enumerate(steps):
        m = min(n, len(steps) - t)
        end = t + m - 1
        falls = terminated and end == len(steps) - 1
        rows.append(
            first._replace(
                reward=sum(GAMMA**i * steps[t + i].reward for i in range(m)),
                next_observation=steps[end].next_observation,
                discount=GAMMA**m * (1 - falls),
                last=end == len(steps) - 1,
            )
        )
    return rows


def equal(one: Transition, other: Transition) -> None:
    for name, a, b in zip(Transition._fields, one, other, strict=True):
        tolerance = 1e-12 if name in ("reward", "discount") else 0
        if a is None or b is None:
            assert a is b
        else:
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 20])
def test_rows_are_the_definition_for_members_in_turn(n: int, rng: np.random.Generator) -> None:
    """Falls and cuts, episodes shorter and longer than n, members interleaved, stopped anywhere."""
    queues = [NStepQueue(n) for _ in range(3)]
    found: list[list[Transition]] = [[], [], []]
    expected: list[list[Transition]] = [[], [], []]
    steps: list[list[Transition]] = [[], [], []]
    for k in range(3):
        for _ in range(20):
            terminated = bool(rng.integers(2))
            played = episode(rng, terminated)
            steps[k] += played
            expected[k] += by_definition(played, n, terminated)
    while any(steps):
        k = int(rng.choice([k for k in range(3) if steps[k]]))
        found[k] += queues[k].push(steps[k].pop(0))
        if rng.random() < 0.3:
            again = NStepQueue(n)
            again.restore({}, queues[k].arrays())
            queues[k] = again
    for k in range(3):
        assert not queues[k].rows
        for one, other in zip(found[k], expected[k], strict=True):
            equal(one, other)


def test_one_step_passes_untouched(rng: np.random.Generator) -> None:
    """The very object, so that nothing changes for who does not ask for more."""
    (step, *_) = episode(rng, terminated=False)
    assert NStepQueue(1).push(step)[0] is step


def test_a_broken_off_episode_keeps_its_rows(rng: np.random.Generator) -> None:
    """They are shorter, bootstrap where they led, and do not say that anything ended."""
    steps = [step._replace(last=False, discount=GAMMA) for step in episode(rng, False) * 2][:2]
    queue = NStepQueue(5)
    assert queue.push(steps[0]) == queue.push(steps[1]) == []
    rows = queue.flush()
    np.testing.assert_allclose([row.discount for row in rows], [GAMMA**2, GAMMA])
    assert not any(row.last for row in rows)
    assert queue.rows == []


def test_rows_of_a_run_lead_over_their_steps(runs: Path) -> None:
    """Two members, falls after 4 steps, 3-step rows: by hand; learning waits for the first row."""
    settings: dict[str, Any] = {**TINY, "steps": 16, "warmup": 0, "gamma": 0.5, "n_step": 3}
    trainer = Trainer(
        "multi-td3", "probe_envs:Corridor-v0", runs=runs, env_kwargs={"falls_at": 4}, **settings
    )
    loop = trainer.loop
    replay = loop.replays[0]
    run_to_end(trainer)
    assert replay.head == 16
    flat = np.fromfile(replay.path, np.float32).reshape(-1, loop.learners.compiled.layout.width)
    rows = loop.learners.compiled.layout.unpack(flat[:8])
    np.testing.assert_array_equal(rows.observation[:, 0], [0, 0, 1, 2, 3, 1, 2, 3])
    np.testing.assert_array_equal(rows.next_observation[:, 0], [3, 3, 4, 4, 4, 4, 4, 4])
    np.testing.assert_array_equal(rows.reward, [1.75, 1.75, 1.75, 1.5, 1, 1.75, 1.5, 1])
    np.testing.assert_array_equal(rows.discount, [0.125, 0.125, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(rows.last, [0, 0, 1, 1, 1, 1, 1, 1])
    assert trainer.progress.updates == 16

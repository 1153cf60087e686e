"""What an update is given, and what becomes of its result, step by step of a short run."""

from pathlib import Path
from typing import Any

import numpy as np
from scripted_runs import start

GAMMA = 0.9
NEVER = np.float32(1)  # the deviation of returns before any was paid


def deviation_of_returns(rows: Any) -> Any:
    """Of the discounted return so far at every step of every member, from the rows alone."""
    returns: list[float] = []
    for mark in (0, 1):
        total = 0.0
        own = rows.observation[:, 0] == mark
        for reward, last in zip(rows.reward[own], rows.last[own], strict=True):
            total = GAMMA * total + reward
            returns.append(total)
            total = 0.0 if last else total
    return np.std(returns) or NEVER


def test_update_is_given_its_sample_and_how_far_the_run_is(runs: Path) -> None:
    """Minibatch, weights, number, statistics, deviation and factors of both members at each call;
    the sampled rows then get the errors found in them.
    """
    trainer = start(
        runs, [[3], [5]], gamma=GAMMA, rule="none", steps=80, replay="prioritized",
        normalize_observation=True, normalize_reward=True, critic_learning_rate=1e-3,
        vary={"critic_learning_rate": (1e-3, 4e-3)},
    )  # fmt: skip
    loop = trainer.loop
    compiled, replay = loop.learners.compiled, loop.replays[0]
    sample, update, feedback = replay.sample, compiled.update, replay.feedback
    samples: list[Any] = []
    told: list[Any] = []
    given: tuple[list[Any], list[Any]] = [], []

    def watched_sample(*words: Any) -> Any:
        samples.append((sample(*words), replay.head))
        return samples[-1][0]

    def watched_update(state: Any, k: int, inputs: Any) -> Any:
        result = update(state, k, inputs)
        given[k].append((inputs, np.array(result.td_error)))
        return result

    def watched_feedback(numbers: Any, td_error: Any) -> None:
        told.append((numbers.copy(), td_error.copy()))
        feedback(numbers, td_error)

    replay.sample, replay.feedback = watched_sample, watched_feedback  # type: ignore[method-assign]
    compiled.update = watched_update  # type: ignore[method-assign]
    while trainer.progress.step < 80:
        loop.tick()
    stored = np.array(replay.rows[:80])
    trainer.close()

    calls = len(samples) // 2
    assert calls == len(given[0]) == len(given[1]) == len(told) // 2 == 20
    deviations = set()
    for n in range(calls):
        for k in (0, 1):
            (drawn, head), (inputs, error) = samples[2 * n + k], given[k][n]
            number, rows, weight, (mean, spread), extra, factors = inputs
            so_far = compiled.layout.unpack(stored[:head])
            assert number == n
            np.testing.assert_array_equal(rows, stored[drawn.numbers])
            np.testing.assert_array_equal(weight, drawn.weight)
            seen = so_far.observation.astype(np.float64)
            np.testing.assert_allclose(mean, seen.mean(axis=0), rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(spread, (seen.var(axis=0) + 1e-8) ** 0.5, rtol=1e-5)
            expected = deviation_of_returns(so_far)
            np.testing.assert_allclose(extra["return_deviation"], expected, rtol=1e-5)
            assert factors == {"critic_learning_rate": (1, 4)[k]}
            numbers, errors = told[2 * n + k]
            np.testing.assert_array_equal(numbers, drawn.numbers)
            np.testing.assert_array_equal(errors, error)
            deviations.add(float(expected))
    assert len(deviations) > 10
    weights = np.array([drawn.weight for drawn, _ in samples[2:]])
    assert np.all(weights.min(axis=-1) < 1)

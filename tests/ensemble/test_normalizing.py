"""Off-policy statistics of observations: what joins them, and what the members act on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripted_runs import IDLE, start

from pacesetter.algorithms.td3 import TD3


def test_members_act_on_observations_scaled_by_all_earlier_ones(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the rows of the replay alone: row r was chosen by what rows before it say, warm-up
    included, with the noise of its own member.
    """
    seen: list[tuple[Any, float]] = []
    act = TD3.act

    def watched(learner: Any, params: Any, noise: Any, observation: Any, rng: Any) -> Any:
        seen.append((observation.copy(), learner.hyper.exploration_noise))
        return act(learner, params, noise, observation, rng)

    monkeypatch.setattr(TD3, "act", watched)
    trainer = start(
        runs, [[3], [5]], (10, 7), rule="none", wait=False, warmup=20, steps=70,
        normalize_observation=True, exploration_noise=0.2,
        vary={"exploration_noise": (0.1, 0.2)}, **IDLE,
    )  # fmt: skip
    loop = trainer.loop
    while trainer.progress.step < 70:
        loop.tick()
    rows = loop.learners.compiled.layout.unpack(np.array(loop.replays[0].rows[:70], np.float64))
    count, mean, squares = loop.experience.normalizer.sums
    trainer.close()

    assert np.all(count == 70)
    np.testing.assert_allclose(mean, rows.observation.mean(axis=0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(squares / 70, rows.observation.var(axis=0), rtol=1e-9)
    assert len(seen) == 50
    for row, (found, noise) in enumerate(seen, start=20):
        now, before = rows.observation[row], rows.observation[:row]
        expected = (now - before.mean(axis=0)) / before.std(axis=0)
        np.testing.assert_allclose(found, np.clip(expected, -10, 10), rtol=1e-4, atol=1e-5)
        assert noise == pytest.approx((0.1, 0.2)[int(now[0])])

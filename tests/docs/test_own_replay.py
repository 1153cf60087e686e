"""The sampler of docs/howto/replay.md: newer transitions more often, and a run that uses it."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import TINY, assert_same, run_to_end, run_to_step

from pacesetter.replay import buffer
from pacesetter.training.trainer import Trainer

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def recent(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(EXAMPLES)
    import recent  # pyright: ignore[reportMissingImports]

    yield recent.Recent
    del sys.modules["recent"]


def test_half_of_the_draws_are_of_the_newest_quarter(recent: Any, rng: np.random.Generator) -> None:
    numbers = recent().sample(rng, (100, 100), range(400, 800), 0.5).numbers
    assert (numbers.min(), numbers.max()) == (400, 799)
    assert (numbers >= 700).mean() == pytest.approx(0.5, abs=0.02)


def test_a_run_that_uses_it_resumes_exactly(
    recent: Any, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(buffer, "make_sampler", lambda hyper, size: recent())
    settings = {**TINY, "steps": 300}
    whole, halves = (Trainer("td3", "Pendulum-v1", runs=runs, name=n, **settings) for n in "ab")
    run_to_step(halves, 150)
    assert_same(run_to_end(whole), run_to_end(Trainer.resume(halves.directory.path)))

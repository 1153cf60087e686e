"""Learning rates that fall over a run."""

from pathlib import Path

import jax
import numpy as np
import optax
import pytest
from short_runs import TINY, run_to_end

from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.learner.schedule import linear
from pacesetter.training.trainer import Trainer


@pytest.mark.parametrize("updates", [0, 1, 37, 100, 250])
def test_linear_is_optax_s_schedule(updates: int) -> None:
    schedule = optax.linear_schedule(1.0, 0.1, 100)
    assert linear(updates, 100, 0.1) == pytest.approx(float(schedule(updates)), abs=1e-7)


def test_the_horizon_is_what_a_member_updates_over_the_budget() -> None:
    """(steps - warm-up) / members * updates per step, by hand."""
    config = resolve("multi-td3", "Pendulum-v1", {"steps": 1100, "warmup": 100, "lr_end": 0.5})
    assert config.hyper.lr_horizon == 1100
    assert config.lr_updates == 500
    config = resolve("td3", "Pendulum-v1", {"steps": 100, "warmup": 20, "updates_per_step": 2,
                                            "lr_horizon": 60, "lr_end": 0})  # fmt: skip
    assert config.lr_updates == 80


def test_updates_of_the_warmup_are_in_the_horizon() -> None:
    """Nothing is idle then: steps / members, by hand."""
    settings = {"steps": 1100, "warmup": 100, "warmup_updates": True, "lr_end": 0.5}
    assert resolve("multi-td3", "Pendulum-v1", settings).lr_updates == 550


def test_at_zero_nothing_moves(runs: Path) -> None:
    """Rates are 0 from the horizon on, while targets still follow their networks."""
    settings = {**TINY, "steps": 400, "lr_end": 0.0, "lr_horizon": 200, "tau": 1.0}
    trainer = Trainer("td3", "Pendulum-v1", runs=runs, **settings)
    while trainer.progress.step < 250:
        trainer.loop.tick()
    before = jax.tree.map(np.array, trainer.loop.learners.states[0])
    run_to_end(trainer)
    after = trainer.loop.learners.states[0]
    assert after.updates > before.updates
    for name in ("actor", "critic"):
        same = jax.tree.map(np.array_equal, getattr(before, name), getattr(after, name))
        assert all(jax.tree.leaves(same)), name


def test_one_is_the_run_without_a_schedule(runs: Path) -> None:
    """Bit for bit, and a factor that only reaches 1 at the end gives other weights."""
    weights = []
    for name, settings in {"a": {}, "b": {"lr_end": 1.0}, "c": {"lr_end": 0.5}}.items():
        trainer = Trainer(
            "sac", "Pendulum-v1", runs=runs, name=name, **{**TINY, "steps": 200, **settings}
        )
        run_to_end(trainer)
        weights.append(np.array(jax.tree.leaves(trainer.loop.learners.states[0].actor)[0]))
    assert np.array_equal(weights[0], weights[1])
    assert not np.array_equal(weights[0], weights[2])


def test_refuses_a_horizon_without_an_end(runs: Path) -> None:
    with pytest.raises(UsageError, match="lr_horizon: needs --lr-end below 1"):
        Trainer("td3", "Pendulum-v1", runs=runs, lr_horizon=100, **TINY)


def test_refuses_a_schedule_over_steps_that_selection_takes() -> None:
    layers = {"lr_end": 0.1, "select_on": "eval"}
    with pytest.raises(UsageError, match=r"lr_end: .*add --no-count-selection-steps"):
        resolve("multi-td3", "Pendulum-v1", layers)
    resolve("multi-td3", "Pendulum-v1", layers | {"count_selection_steps": False})

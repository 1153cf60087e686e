"""Tasks whose values and best actions are known are learned, and stored, as they are."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numeric import near
from short_runs import TINY, run_to_end

from pacesetter.algorithms.sunrise import Sunrise
from pacesetter.training.trainer import Trainer

LEARNS: dict[str, Any] = {
    **TINY,
    "hidden": (64, 64),
    "batch_size": 64,
    "steps": 1_000,
    "warmup": 200,
    "gamma": 0.5,
    "tau": 0.05,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 3e-3,
    "exploration_noise": 0.5,
    "eval_every": 10_000,
}
NO_ENTROPY: dict[str, Any] = {  # values are returns alone, and the policy can settle
    "initial_alpha": 0.01,
    "alpha_learning_rate": 1e-6,
    "exploration_noise": None,
}
FEW = {"ensemble": 3}
# Before renorm, values by the running statistics are not yet those of the batches that it learns;
# small batches' statistics leave a noise of what `near` allows until the rates fall.
CROSSQ = NO_ENTROPY | {
    "critic_hidden": (64, 64),
    "tau": None,
    "steps": 2_000,
    "renorm_after": 100,
    "lr_end": 0.05,
}
NORM = {"critic_layer_norm": True, "actor_layer_norm": True}
NOISY = {"exploration": "parameter", "actor_layer_norm": True}
# Actions of all kinds are seen early; later noise would keep a policy for its luck.
ASSESSED = {"assess": 5, "assess_after": 0, "warmup": 500, "steps": 1_500, "exploration_noise": 0.1}
# Blocks of the usual 1,000 steps would leave it with the first policy to the end.
OFFICIAL = {"reference": "official", "update_every": 100, "warmup": 500, "steps": 1_500}
MODELS = {"model_hidden": (32,), "head_hidden": (16,), "critic_members": 2}
# As many updates as the others make, in half the steps.
MANY = {"critics": 5, "updates_per_step": 2.0, "policy_delay": 2, "steps": 700}
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "td3": ("td3", {}),
    "ddpg": ("ddpg", {}),
    "sac": ("sac", NO_ENTROPY),
    "crossq": ("crossq", CROSSQ),
    "layer-norm": ("td3", NORM),
    "quantiles": ("td3", {"quantiles": 25}),
    "sac-quantiles": ("sac", NO_ENTROPY | {"quantiles": 25}),
    "parameter": ("td3", NOISY),
    "ddpg-parameter": ("ddpg", NOISY),
    "ou": ("td3", {"exploration": "ou"}),
    "ddpg-ou": ("ddpg", {"exploration": "ou"}),
    "assess": ("td3", ASSESSED),
    "sunrise": ("sunrise", NO_ENTROPY | FEW),
    "sunrise-official": ("sunrise", NO_ENTROPY | FEW | OFFICIAL),
    "sunrise-td3": ("sunrise-td3", FEW),
    "tqc": ("tqc", NO_ENTROPY | {"critics": 2, "dropped": 0}),
    "redq": ("redq:REDQ", NO_ENTROPY | MANY),
    "steve": ("steve", MODELS | {"exploration_noise": 2.0}),
    "steve-td3": ("steve-td3", MODELS),
}


def kinds(*quick: str) -> Any:
    """All kinds of learner; those that are not quick here are slow tests."""
    slow = pytest.mark.slow
    params = [pytest.param(kind, marks=() if kind in quick else slow) for kind in KINDS]
    return pytest.mark.parametrize("algorithm", params)


both = kinds("td3", "ddpg")
every = kinds("td3", "ddpg", "sac", "crossq", "quantiles", "parameter", "ou", "assess", "redq")


def learn(
    kind: str, env: str, runs: Path, settings: dict[str, Any] | None = None, **kwargs: Any
) -> Trainer:
    algorithm, more = KINDS[kind]
    options = LEARNS | more | (settings or {})
    options = {name: value for name, value in options.items() if value is not None}
    trainer = Trainer(algorithm, f"probe_envs:{env}", runs=runs, env_kwargs=kwargs, **options)
    run_to_end(trainer)
    return trainer


def values(trainer: Trainer, observation: float, actions: Any = (-0.8, 0.0, 0.8)) -> Any:
    """Every critic's value (..., critics, actions) of actions in [-1, 1]."""
    critic = jax.device_get(trainer.loop.learners.states[0].critic)
    action = np.array(actions, np.float32)[:, None]
    algorithm: Any = trainer.loop.learners.compiled.learner
    ask = algorithm.values if hasattr(algorithm, "values") else members_values(algorithm)
    return jax.jit(ask)(critic, np.full_like(action, observation), action)


def members_values(algorithm: Sunrise) -> Any:
    """The values of all learners in an ensemble (N, critics, actions)."""
    return jax.vmap(algorithm.base.values, (0, None, None))


@both
def test_constant_reward(algorithm: str, runs: Path) -> None:
    """One step, reward 1: every action is worth 1."""
    near(values(learn(algorithm, "ConstantReward-v0", runs), 0), 1)


@both
def test_reward_that_is_seen(algorithm: str, runs: Path) -> None:
    """One step, the reward is the observation: -1 and 1 are worth themselves."""
    trainer = learn(algorithm, "ObservationReward-v0", runs)
    near(values(trainer, -1), -1)
    near(values(trainer, 1), 1)


@both
def test_reward_that_comes_later(algorithm: str, runs: Path) -> None:
    """Two steps, reward 1 on the second: the first is worth gamma."""
    trainer = learn(algorithm, "TwoSteps-v0", runs)
    near(values(trainer, 0), 0.5)
    near(values(trainer, 1), 1)


@both
def test_reward_of_the_action(algorithm: str, runs: Path) -> None:
    """Reward -4 (a - .5)^2: the actor finds .5, the critic the parabola."""
    trainer = learn(algorithm, "ActionReward-v0", runs)
    near(trainer.policy()(np.zeros(1)), 0.5)
    near(values(trainer, 0, [0.3, 0.5, 0.7]), [-0.16, 0, -0.16])
    near(values(trainer, 0, [0.0]), -1)


@every
def test_reward_of_the_action_that_fits_what_is_seen(algorithm: str, runs: Path) -> None:
    """Reward -4 (a - s/2)^2 for s = -1 or 1."""
    trainer = learn(algorithm, "BothReward-v0", runs)
    near(trainer.policy()(np.array([[-1], [1]])), [[-0.5], [0.5]])
    near(values(trainer, -1, [-0.5]), 0)
    near(values(trainer, 1, [0.5]), 0)
    near(values(trainer, 1, [0.0]), -1)


@both
def test_action_in_units_of_a_lopsided_box(algorithm: str, runs: Path) -> None:
    """Best is 1 in a box of 0 to 4, which is -.5 for the critic."""
    trainer = learn(algorithm, "ActionReward-v0", runs, low=0.0, high=4.0, best=1.0, steepness=1.0)
    near(trainer.policy().act(np.zeros(1)), -0.5)
    near(trainer.policy()(np.zeros(1)) / 2, 0.5)
    near(values(trainer, 0, [-0.5]), 0)


@both
def test_time_limit_is_no_end_of_the_task(algorithm: str, runs: Path) -> None:
    """Reward 1 for ever, cut after 3 steps, is worth 1 / (1 - .5), not the sum of 3."""
    trainer = learn(algorithm, "Corridor-v0", runs, blind=True, max_episode_steps=3)
    near(values(trainer, 0), 2)


@every
def test_a_fall_is_the_end_of_the_task(algorithm: str, runs: Path) -> None:
    """Reward 1 for 3 steps is worth 1 + .5 + .25, then less."""
    trainer = learn(algorithm, "Corridor-v0", runs, falls_at=3)
    for seen, value in enumerate([1.75, 1.5, 1]):
        near(values(trainer, seen), value)


# Other rows, drawn otherwise.

learners = pytest.mark.parametrize(
    "algorithm", ["td3", pytest.param("sac", marks=pytest.mark.slow)]
)
DRAWS: dict[str, dict[str, Any]] = {
    "prioritized": {"replay": "prioritized"},
    "lap": {"replay": "lap"},
    "return": {"replay": "return"},
    "to-go": {"replay": "return", "replay_to_go": True, "replay_importance": 0.4},
}


@learners
@pytest.mark.parametrize("kind", DRAWS)
def test_every_replay_learns_the_same(kind: str, algorithm: str, runs: Path) -> None:
    """How rows are drawn moves no fixed point: reward -4 (a - s/2)^2 for s = -1 or 1."""
    trainer = learn(algorithm, "BothReward-v0", runs, DRAWS[kind])
    near(trainer.policy()(np.array([[-1], [1]])), [[-0.5], [0.5]])
    near(values(trainer, -1, [-0.5]), 0)
    near(values(trainer, 1, [0.5]), 0)


@learners
@pytest.mark.parametrize("n", [2, 3, 7])
def test_rows_of_several_steps_up_to_a_fall(n: int, algorithm: str, runs: Path) -> None:
    """The same values as with one step, from rows that end at the fall or before it."""
    trainer = learn(algorithm, "Corridor-v0", runs, {"n_step": n}, falls_at=3)
    for seen, value in enumerate([1.75, 1.5, 1]):
        near(values(trainer, seen), value)


@learners
def test_rows_of_several_steps_up_to_a_cut(algorithm: str, runs: Path) -> None:
    """Rows of 3, 2 and 1 steps all bootstrap: reward 1 for ever is worth 2."""
    kwargs = {"blind": True, "max_episode_steps": 3}
    trainer = learn(algorithm, "Corridor-v0", runs, {"n_step": 3}, **kwargs)
    near(values(trainer, 0), 2)


# What the replay holds.


def stored(env: str, runs: Path, steps: int, **settings: Any) -> Any:
    """All transitions of a run that does not learn."""
    settings = {**TINY, "steps": steps, "updates_per_step": 1e-9, **settings}
    trainer = Trainer("td3", f"probe_envs:{env}", runs=runs, **settings)
    loop = trainer.loop
    replay = loop.replays[0]
    run_to_end(trainer)
    path = replay.path
    rows = np.fromfile(path, np.float32).reshape(-1, loop.learners.compiled.layout.width)[:steps]
    return jax.device_get(loop.learners.compiled.layout.unpack(rows))


@pytest.mark.parametrize(
    ("kwargs", "discount"),
    [
        ({"falls_at": 3}, 0),
        ({"falls_at": 3, "max_episode_steps": 3}, 0),  # a fall on the last step of the limit
        ({"falls_at": 3, "cut_at": 3}, 0),  # both flags at once, from the task itself
        ({"max_episode_steps": 3}, 0.9),
        ({"cut_at": 3}, 0.9),
    ],
)
def test_ends_are_stored_as_what_they_are(
    kwargs: dict[str, int], discount: float, runs: Path
) -> None:
    """Only a fall stops the sum; the row leads to the final observation, not to the next start."""
    rows = stored("Corridor-v0", runs, 9, env_kwargs=kwargs, gamma=0.9)
    np.testing.assert_array_equal(rows.observation[:, 0], [0, 1, 2] * 3)
    np.testing.assert_array_equal(rows.next_observation[:, 0], [1, 2, 3] * 3)
    np.testing.assert_array_equal(rows.last, [0, 0, 1] * 3)
    np.testing.assert_allclose(rows.discount, [0.9, 0.9, discount] * 3, rtol=1e-6)
    np.testing.assert_array_equal(rows.reward, np.ones(9))


@pytest.mark.parametrize(
    ("low", "high"), [([-1, 0], [3, 10]), ([-0.4, -0.4], [0.4, 0.4]), ([-1, -1], [1, 1])]
)
@pytest.mark.parametrize("warmup", [60, 0])
def test_stored_actions_are_those_that_were_done(
    low: list[float], high: list[float], warmup: int, runs: Path
) -> None:
    """The env echoes what it was given: the stored action, cut to [-1, 1] and put in the box."""
    rows = stored(
        "Echo-v0",
        runs,
        60,
        env_kwargs={"low": low, "high": high},
        warmup=warmup,
        exploration_noise=3.0,
    )
    assert np.abs(rows.action).max() <= 1
    cut = np.mean(np.abs(rows.action) == 1)
    assert cut == 0 if warmup else 0.3 < cut < 1  # P(|N(0, 3)| > 1) is .74 around 0
    low_, high_ = np.array(low), np.array(high)
    done = low_ + (high_ - low_) * (rows.action.astype(float) + 1) / 2
    np.testing.assert_allclose(rows.next_observation, done, rtol=1e-6, atol=1e-6)
    assert np.all(rows.next_observation >= low_.astype(np.float32))
    assert np.all(rows.next_observation <= high_.astype(np.float32))

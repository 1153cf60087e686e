"""TQC: which quantiles a target keeps, what critics and the actor move towards, what is SAC's own.

That it learns is in test_probe.py.
"""

from typing import Any

import jax
import numpy as np
import pytest
from numeric import (
    KEY,
    SPEC,
    close,
    member,
    perceptron,
    quantile_loss,
    random_batch,
    random_state,
    says,
    single,
)

from pacesetter.algorithms import sac, tqc
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.networks import gaussian

NETWORKS = ("actor", "critic", "target_critic")


def learner(**hyper: Any) -> tqc.TQC:
    return tqc.TQC(SPEC, tqc.Hyper(**{"hidden": (5, 4), "critics": 3, "quantiles": 4, **hyper}))


def test_the_largest_of_all_critics_are_dropped() -> None:
    """One critic with the larger quantiles loses more than one with the smaller."""
    outputs = np.array([[[1.0, 9, 5, 3]], [[2, 8, 6, 20]], [[0, 4, 7, 30]]], np.float32)
    kept = learner(dropped=1).next_q(outputs, KEY)
    assert kept.tolist() == [[0], [1], [2], [3], [4], [5], [6], [7], [8]]
    assert learner(dropped=3).next_q(outputs, KEY).tolist() == [[0], [1], [2]]


def test_one_update_of_critics_is_that_of_the_formulas(rng: np.random.Generator) -> None:
    """The loss of all critics on the pooled target, number by number in NumPy."""
    algorithm = learner(dropped=2, initial_alpha=0.3)
    with jax.enable_x64(True):
        state = random_state(algorithm, rng, *NETWORKS)
        batch = random_batch(rng, SPEC, 6)
        _, (loss, _) = algorithm.critic_step(state, batch, KEY)
        action, log_prob = gaussian.sample(state.actor, batch.next_observation, KEY)
    expected = 0.0
    for row in range(6):
        pair = np.concatenate([batch.next_observation[row], np.asarray(action)[row]])
        pooled = np.sort(
            np.concatenate([perceptron(member(state.target_critic, i), pair) for i in range(3)])
        )[:6]
        soft = pooled - 0.3 * float(log_prob[row])
        target = batch.reward[row] + batch.discount[row] * soft
        now = np.concatenate([batch.observation[row], batch.action[row]])
        for i in range(3):
            outputs = perceptron(member(state.critic, i), now)
            expected += batch.weight[row] * quantile_loss(outputs, target) / 6
    assert float(loss) == pytest.approx(expected, rel=1e-6)


def test_one_critic_that_drops_nothing_is_sac_with_quantiles(rng: np.random.Generator) -> None:
    mine = learner(critics=1, dropped=0)
    plain = sac.SAC(SPEC, sac.Hyper(hidden=(5, 4), critics=1, quantiles=4))
    state = single(random_state(mine, rng, *NETWORKS))
    batch = single(random_batch(rng, SPEC, 1, 7))
    one, other = (jax.jit(each.update)(state, batch, KEY) for each in (mine, plain))
    close(one.state, other.state, rtol=1e-4, atol=1e-6)


def test_actor_climbs_the_mean_of_all_critics(rng: np.random.Generator) -> None:
    """The loss is alpha log pi less that mean, with alpha 1."""
    algorithm = learner()
    state = single(random_state(algorithm, rng, *NETWORKS))
    state = state._replace(critic=says(state.critic, [[1.0, 1, 1, 1], [2, 2, 2, 2], [9, 9, 9, 9]]))
    batch = single(random_batch(rng, SPEC, 7))
    _, losses = jax.jit(algorithm.fit_actor)(state, batch, KEY)
    assert losses["actor_loss"] == pytest.approx(-float(losses["entropy"]) - 4, rel=1e-5)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"dropped": 25}, r"^dropped: must leave a quantile of the 25; allowed: 0 to 24, got 25$"),
        ({"quantiles": 0}, r"^quantiles: .*greater than or equal to 1, got 0$"),
        ({"replay": "lap"}, r"^replay: unknown 'lap'; allowed: prioritized, return, uniform$"),
    ],
)
def test_what_cannot_be_is_refused(settings: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError, match=line):
        resolve("tqc", "Pendulum-v1", settings)


@pytest.mark.parametrize("quantiles", [1, 2])
def test_refuses_to_drop_all_quantiles_by_default_too(quantiles: int) -> None:
    with pytest.raises(UsageError, match="dropped"):
        resolve("tqc", "Walker2d-v5", {"quantiles": quantiles})
    assert resolve("tqc", "Walker2d-v5", {"quantiles": quantiles, "dropped": 0})

"""REDQ of examples/: which critics a target uses, whom the actor climbs, what is SAC's own.

That it learns is in test_probe.py.
"""

from typing import Any

import jax
import numpy as np
import pytest
import redq
from numeric import KEY, SPEC, random_batch, random_state, same, says, single
from scipy.stats import chisquare

from pacesetter.algorithms import sac
from pacesetter.batch import Batch
from pacesetter.cli.main import main

NETWORKS = ("actor", "critic", "target_critic")


def learner(**hyper: Any) -> redq.REDQ:
    return redq.REDQ(SPEC, redq.Hyper(**{"hidden": (5, 4), **hyper}))


def state_and_batch(algorithm: sac.SAC, rng: np.random.Generator) -> tuple[sac.State, Batch]:
    state = random_state(algorithm, rng, *NETWORKS)
    return single(state), single(random_batch(rng, SPEC, algorithm.updates_per_call, 7))


def test_a_target_uses_a_random_pair(rng: np.random.Generator) -> None:
    """Critic i says i, so the minimum of two of ten is i in (9 - i) of 45 pairs, and never 9."""
    algorithm = learner(initial_alpha=1e-30)
    state, batches = state_and_batch(algorithm, rng)
    state = state._replace(target_critic=says(state.target_critic, np.arange(10.0)[:, None]))
    batch = jax.tree.map(lambda x: x[0], batches)
    batch = batch._replace(reward=np.zeros(7, np.float32), discount=np.ones(7, np.float32))
    keys = jax.random.split(KEY, 4500)
    draw = jax.jit(jax.vmap(algorithm.target, (None, None, 0)))
    targets = np.round(draw(state, batch, keys), 6)
    assert np.all(targets == targets[:, :1])  # one pair for a whole minibatch
    counts = np.bincount(targets[:, 0].astype(int), minlength=10)
    assert counts[9] == 0
    assert chisquare(counts[:9], 100 * np.arange(9, 0, -1)).pvalue > 1e-3


def test_pairs_are_drawn_apart_from_the_next_action(rng: np.random.Generator) -> None:
    """The next action's key, and so SAC's target, is the same whatever is drawn besides."""
    algorithm = learner(critics=2, policy_delay=1)
    plain = sac.SAC(SPEC, sac.Hyper(hidden=(5, 4)))
    state, batch = state_and_batch(algorithm, rng)
    one, other = (
        jax.jit(each.target)(state, jax.tree.map(lambda x: x[0], batch), KEY)
        for each in (algorithm, plain)
    )
    assert same(one, other)  # of two critics both are the pair


def test_actor_climbs_the_mean_of_all_critics(rng: np.random.Generator) -> None:
    """The loss is alpha log pi less that mean, on the critics that have moved."""
    algorithm = learner(critics=4, policy_delay=2)
    state, batch = state_and_batch(algorithm, rng)
    state = state._replace(critic=says(state.critic, [[1.0], [2], [3], [10]]))
    last = jax.tree.map(lambda x: x[-1], batch)
    _, losses = jax.jit(algorithm.fit_actor)(state, last, KEY)
    assert losses["actor_loss"] == pytest.approx(-float(losses["entropy"]) - 4, rel=1e-5)


def test_critics_move_at_every_update_and_the_actor_once(rng: np.random.Generator) -> None:
    algorithm = learner(critics=3, policy_delay=5)
    state, batch = state_and_batch(algorithm, rng)
    update = jax.jit(algorithm.update)(state, batch, KEY)
    new = update.state
    counts = [new.critic_opt_state, new.actor_opt_state, new.alpha_opt_state]
    assert [int(adam[0].count) for adam in counts] == [5, 1, 1]
    assert (int(new.updates), update.td_error.shape) == (5, (5, 7))


def test_no_key_is_used_twice(rng: np.random.Generator) -> None:
    algorithm = learner(policy_delay=3)
    state, batch = state_and_batch(algorithm, rng)
    with jax.debug_key_reuse(True):
        jax.eval_shape(jax.jit(algorithm.update), state, batch, KEY)


def test_command_knows_it_and_its_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "redq:REDQ", "Hopper-v5", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "critics, of which a target uses two" in text
    assert "critic updates per actor update" in text

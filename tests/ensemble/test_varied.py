"""Members that differ: how settings are spread, what a member learns with, who inherits them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import fresh, learner
from numeric import all_differ
from scripted_runs import ENV, IDLE, start
from short_runs import log, run_to_end

from pacesetter.batch import Layout
from pacesetter.cli.flags import add_settings, parser
from pacesetter.config import Run, resolve
from pacesetter.ensemble.rules import Choice, choose
from pacesetter.ensemble.varied import decided, inherited, shown, spread
from pacesetter.errors import UsageError
from pacesetter.learner.compiled import CompiledLearner, UpdateInputs
from pacesetter.learner.scales import scale_of, value_of
from pacesetter.settings.ensemble import VARIABLE
from pacesetter.training.trainer import Trainer

GAMMAS, RATES = (0.98, 0.99, 0.995), (1e-4, 3e-4, 1e-3)
VARY: dict[str, Any] = {"gamma": GAMMAS, "critic_learning_rate": RATES}
STILL = np.zeros(3, np.float32), np.ones(3, np.float32)


def config(algorithm: str = "td3", **settings: Any) -> Any:
    return resolve(algorithm, ENV, {"members": 9, "rule": "none", **settings})


def settings_of(found: Any, seed: int = 0) -> dict[str, list[float]]:
    """What each member begins with."""
    return shown(found.run, found.hyper, spread(found.run, found.hyper, seed))


# How settings are spread.


def test_grid_gives_every_point_in_turn() -> None:
    found = settings_of(config(members=18, vary=VARY))
    assert found["gamma"] == [g for g in GAMMAS for _ in RATES] * 2
    assert found["critic_learning_rate"] == list(RATES) * 6


def test_draw_gives_each_value_as_often_in_an_order_of_the_seed() -> None:
    found = [settings_of(config(members=6, vary=VARY, vary_by="draw"), seed) for seed in (0, 0, 1)]
    assert found[0] == found[1] != found[2]
    for values in found:
        assert sorted(values["gamma"]) == sorted(GAMMAS * 2)
        assert sorted(values["critic_learning_rate"]) == sorted(RATES * 2)


@pytest.mark.parametrize("name", VARIABLE)
def test_factors_and_values_are_inverse(name: str) -> None:
    for base in (0.3, 0.99):
        assert scale_of(name, base, base) == pytest.approx(1)
        assert value_of(name, base, scale_of(name, base, 0.7)) == pytest.approx(0.7)
    assert value_of("gamma", 0.99, 2.0) == pytest.approx(0.98)  # twice as far from 1


def test_words_and_tables_say_the_same() -> None:
    """Flags may be repeated and written with dashes; their result is the table's."""
    command = parser("train", "")
    add_settings(command, "run", Run, None)
    words = ["--vary", "critic-learning-rate=1e-4,3e-4,1e-3", "--vary=gamma=.98,.99,.995"]
    given = vars(command.parse(words))
    assert config(**given).run.vary == config(vary=VARY).run.vary
    assert config(vary=config(vary=VARY).run.vary).run == config(vary=VARY).run


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"vary": {"tau": [0.1, 0.2]}}, "vary: 'tau' cannot differ; allowed: actor_learning_rate"),
        ({"vary": {"alpha_learning_rate": [1, 2]}}, "vary: 'alpha_learning_rate' cannot differ"),
        ({"vary": {"gamma": [0.9, 1.5, 1]}}, "vary: gamma: should be less than or equal to 1, got"),
        ({"vary": ["gamma=0.9"]}, "vary: gamma needs at least two different values"),
        ({"vary": ["gamma"]}, "vary: must be NAME=VALUE,VALUE"),
        ({"vary": ["gamma=.9,x"]}, "vary: should be a valid number"),
        ({"vary": ["gamma=.9,.8", "gamma=.7,.6"]}, "vary: has gamma twice"),
        ({"vary": VARY, "members": 1}, "vary: needs several members, got 1"),
        ({"vary": VARY, "members": 3}, "members: the grid of --vary has 9 points, got 3 members"),
        (
            {"vary": ["gamma=.9,.8"], "members": 2, "n_step": 3},
            "vary: gamma .*n_step=3.*--n-step 1",
        ),
        ({"vary": ["gamma=.9,.8"], "members": 2, "gamma": 1}, "vary: gamma itself is 1"),
        ({"rule": "pbt"}, "rule: pbt perturbs settings, but none vary; give --vary"),
        (
            {"vary": ["exploration_noise=.1,.2"], "members": 2, "exploration_noise": 0},
            "vary: exploration_noise itself is 0",
        ),
    ],
)
def test_refused_in_one_line(settings: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError, match=line):
        config(**settings)


def test_one_member_algorithms_refuse_it() -> None:
    with pytest.raises(UsageError, match=r"^vary: trpo trains one member"):
        resolve("trpo", ENV, {"vary": ["gamma=.9,.8"]})


# What a member learns with, and how it acts.


def rows_of(layout: Layout, gamma: float, rng: np.random.Generator) -> Any:
    """Two minibatches, every third row of which ends an episode, with a run's own gamma."""
    rows = rng.normal(size=(2, 16, layout.width)).astype(np.float32)
    batch = layout.unpack(rows)
    ended = np.arange(16) % 3 == 0
    column = np.flatnonzero(np.isin(np.round(rows[0, 0], 6), np.round(batch.discount[0, 0], 6)))
    rows[..., column] = (gamma * (1 - ended))[None, :, None].astype(np.float32)
    assert set(np.unique(layout.unpack(rows).discount)) == {0, np.float32(gamma)}
    return rows


@pytest.mark.parametrize("name", ["td3", "sac", "sunrise", "steve-td3"])
def test_scaled_learner_is_the_learner_of_those_settings(
    name: str, rng: np.random.Generator
) -> None:
    """One update with factors equals that of a learner built with the values, on rows of its own
    gamma; an ensemble hands them to the learners that it is made of.
    """
    small = {"model_hidden": (8,), "head_hidden": (8,)} if name == "steve-td3" else {}
    plain = learner(name, critic_learning_rate=1e-3, **small)
    wanted = {"gamma": 0.9, "critic_learning_rate": 2e-3, "actor_learning_rate": 1e-4}
    other = plain.build(plain.spec, replace(plain.hyper, **wanted))
    scales = {n: scale_of(n, getattr(plain.hyper, n), value) for n, value in wanted.items()}
    layout = Layout(plain.spec, masks=len(plain.mask(rng)))
    before = fresh(plain) if name in ("td3", "steve-td3") else plain.init(jax.random.key(1))
    seed = int(rng.integers(2**31))
    found: list[Any] = []
    for made, gamma, factors in ((plain, 0.99, scales), (other, 0.9, {})):
        rows = rows_of(layout, gamma, np.random.default_rng(seed))[: made.updates_per_call]
        state = jax.tree.map(jnp.array, before)
        compiled = CompiledLearner(made, layout, 0, normalize=False)
        update = compiled.update(state, 0, UpdateInputs(3, rows, None, STILL, scales=factors))
        found.append(jax.device_get((update.state, update.td_error)))
    for one, two in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, two, rtol=2e-4, atol=1e-6)


def test_members_that_differ_share_one_program(runs: Path) -> None:
    """After selections too, the update has been compiled once."""
    vary = {"gamma": (0.9, 0.99), "critic_learning_rate": (1e-4, 1e-3)}
    trainer = start(
        runs, [[1], [2], [3], [4]], (10,) * 4, members=4, vary=vary, rule="pbt", select_window=1,
        steps=160,
    )  # fmt: skip
    run_to_end(trainer)
    assert trainer.progress.updates > 0
    assert trainer.loop.learners.compiled._update._cache_size() == 1
    states = jax.device_get(trainer.loop.learners.states)
    assert all_differ(states[1].critic, states[3].critic)


def test_members_explore_by_their_own_noise(runs: Path) -> None:
    """The same draw, at the noise of the run and at half of it."""
    vary = {"exploration_noise": (0.1, 0.2)}
    trainer = start(runs, rule="none", vary=vary, exploration_noise=0.2, **IDLE)
    loop, observation, offsets = trainer.loop, np.ones(3, np.float32), []
    for k, explorer in enumerate(loop.explorers):
        explorer.act_stream = np.random.default_rng(5)
        params = loop.learners.policy_params[k]
        noisy = explorer.act(params, observation, loop.progress.members[k].scales)
        quiet = loop.policy(k).act(observation)
        offsets.append(noisy - quiet)
    np.testing.assert_allclose(2 * offsets[0], offsets[1], rtol=1e-4)
    trainer.close()


# Who inherits them.


def test_best_leaves_everyone_their_own_settings(runs: Path) -> None:
    """The winner's networks go to all, so that settings compete from the same start."""
    vary = {"gamma": (0.9, 0.95, 0.99)}
    trainer = start(runs, members=3, vary=vary, steps=90)
    rows = log(run_to_end(trainer))
    assert {tuple(row["parents"]) for row in rows if row["kind"] == "select"} == {(1, 1, 1)}
    told = [row["settings"] for row in rows if row["kind"] != "train"]
    assert told == [{"gamma": [0.9, 0.95, 0.99]}] * len(told)


def test_pbt_hands_on_settings_perturbed_within_their_range(runs: Path) -> None:
    """The worst of four takes the best one's state and its settings, each times 0.8 or 1.2 (of
    gamma, 1 - gamma), but never beyond what --vary lists; the log tells the values.
    """
    vary = {"gamma": (0.9, 0.99), "critic_learning_rate": (1e-4, 1e-3)}
    trainer = start(
        runs, [[1], [2], [3], [4]], (10,) * 4, members=4, vary=vary, rule="pbt", select_window=1,
        steps=200, **IDLE,
    )  # fmt: skip
    rows = [row for row in log(run_to_end(trainer)) if row["kind"] == "select"]
    before = {"gamma": [0.9, 0.9, 0.99, 0.99], "critic_learning_rate": [1e-4, 1e-3] * 2}
    assert len(rows) == 5
    rates = set()
    for row in rows:
        assert row["parents"] == [3, 1, 2, 3]
        for name, values in before.items():
            assert row["settings"][name][1:] == values[1:]
        rates.add((row["settings"]["critic_learning_rate"][0], row["settings"]["gamma"][0]))
    assert rates <= {(r, g) for r in (8e-4, 1e-3) for g in (0.99, 0.988)}
    assert len(rates) > 1


@pytest.mark.parametrize("rule", ["none", "rescue", "average"])
def test_choices_without_scales_leave_settings(rule: str) -> None:
    before = [{"gamma": 1.0}, {"gamma": 2.0}]
    choice = choose(rule, np.array([[0.0, 0.0], [9.0, 9.0]]), np.random.default_rng(0))
    assert (choice.parents.tolist() == [1, 1]) == (rule != "none")
    assert inherited(choice, before) == before


def test_perturbations_move_both_ways_and_only_who_is_asked() -> None:
    found = config(members=2, vary={"critic_learning_rate": (1e-5, 1e-1)}, vary_by="draw")
    choice = Choice(np.array([0, 0]), perturb=np.array([False, True]))
    before = [{"critic_learning_rate": 1.0}, {"critic_learning_rate": 7.0}]
    rng, seen = np.random.default_rng(0), set()
    for _ in range(20):
        scales = inherited(decided(choice, found.run, found.hyper, before, rng), before)
        assert scales[0] == before[0]
        seen.add(round(scales[1]["critic_learning_rate"], 6))
    assert seen == {0.8, 1.2}


def test_settings_of_a_stopped_run_go_on(runs: Path) -> None:
    trainer = start(runs, rule="none", vary={"gamma": (0.9, 0.99)}, steps=40, **IDLE)
    before = [member.scales for member in trainer.progress.members]
    directory = run_to_end(trainer)
    resumed = Trainer.resume(directory.path, steps=60)
    assert [member.scales for member in resumed.progress.members] == before
    assert before[0] != before[1]
    resumed.close()


def test_refuses_gammas_whose_returns_leave_the_bins() -> None:
    with pytest.raises(UsageError, match="vary: gamma cannot differ with --bins"):
        resolve("crossq-bins", "Pendulum-v1", {"members": 2, "vary": {"gamma": (0.98, 0.99)}})


def test_refuses_noise_on_weights_that_differs() -> None:
    """Its deviation adapts, and goes with the networks that are copied."""
    noisy = {"exploration": "parameter", "actor_layer_norm": True, "members": 2}
    with pytest.raises(UsageError, match="vary: exploration_noise cannot differ"):
        resolve("td3", "Pendulum-v1", noisy | {"vary": {"exploration_noise": (0.05, 0.4)}})

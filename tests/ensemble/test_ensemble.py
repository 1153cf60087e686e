"""Multi-TD3: what a selection copies and what it does not, who is counted, and what is shared."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from learners import SPEC, learner
from numeric import all_differ, same
from scripted_runs import ENV, IDLE, script, start
from short_runs import assert_same, content, log, run_to_end

from pacesetter.algorithms.contract import Learner, Update
from pacesetter.batch import Layout
from pacesetter.ensemble.copying import copy_from_parents
from pacesetter.ensemble.rules import RULES, Choice, choose
from pacesetter.ensemble.selection import POOLED_SELECTIONS, Selection, measure
from pacesetter.envs import Environment, Recipe, environment
from pacesetter.errors import UsageError
from pacesetter.learner.compiled import KEYS, CompiledLearner, KeyUse, UpdateInputs
from pacesetter.policy import normalize
from pacesetter.seeding import Stream, episode_seed
from pacesetter.training.trainer import Report, Trainer

NETWORKS = ("actor", "critic", "target_actor", "target_critic")


@contextmanager
def until(trainer: Trainer, kind: str) -> Iterator[Report]:
    """The first report of a kind, with the trainer as it is at that moment."""
    reports = iter(trainer)
    found = next((report for report in reports if report.kind == kind), None)
    assert found is not None, f"the run ended without a {kind}"
    try:
        yield found
    finally:
        reports.close()  # type: ignore[attr-defined]


def select_rows(trainer: Trainer) -> list[dict[str, Any]]:
    return [row for row in log(run_to_end(trainer)) if row["kind"] == "select"]


# One member, and members that do not meet.


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"select_on": "eval", "select_every": 20, "wait": False, "rule": "random", "copy": "actor"},
    ],
)
def test_one_member_is_plain_td3(more: dict[str, Any], runs: Path) -> None:
    """All arrays, counters, streams, replay hashes and logs, rounds past the warm-up."""
    settings: dict[str, Any] = {"warmup": 25, "steps": 75}
    multi = start(runs, members=1, name="multi", **settings, **more)
    plain = start(runs, algorithm="td3", name="plain", **settings)
    plain.loop.selector.next_trials = multi.loop.selector.next_trials  # of trials, which none has
    assert_same(run_to_end(multi), run_to_end(plain))
    assert plain.progress.updates == 50


def test_members_that_do_not_meet_learn_as_if_alone(runs: Path) -> None:
    """With a replay of its own and no selection, member 0 ends where a lone td3 does."""
    alone = start(runs, algorithm="td3", name="alone", steps=60)
    apart = start(
        runs, lengths=(10, 7), rule="none", replay_scope="member", name="apart", steps=102
    )
    run_to_end(alone)
    run_to_end(apart)
    assert apart.progress.members[0].steps == alone.progress.members[0].steps == 60
    one, other = (jax.device_get(trainer.loop.learners.states[0]) for trainer in (apart, alone))
    assert same(one, other)


# A selection.


def test_selection_copies_the_winner_whole(runs: Path) -> None:
    """After returns 3 and 5 both hold what member 1 held: networks, moments and counter."""
    trainer = start(runs)
    before: list[Any] = []
    apply = trainer.loop.apply

    def watched(selection: Selection) -> None:
        before.extend(jax.device_get(trainer.loop.learners.states))
        apply(selection)

    trainer.loop.apply = watched
    with until(trainer, "select") as report:
        assert report.step == 20
        assert report.values["returns"] == [[3], [5]]
        assert report.values["parents"] == [1, 1]
        assert report.values["champion"] == trainer.progress.champion == 1
        winner, after = before[1], jax.device_get(trainer.loop.learners.states)
    moments = [x for x in jax.tree.leaves(winner.critic_opt_state) if x.ndim]
    assert all(np.any(x) for x in moments)
    assert winner.updates == 10
    for part in NETWORKS:
        assert all_differ(getattr(before[0], part), getattr(winner, part))
    assert same(after[0], winner)
    assert same(after[1], winner)


def test_copies_share_no_buffer_and_no_noise(runs: Path, rng: np.random.Generator) -> None:
    """An update of one leaves the other, and for one observation the two act differently."""
    trainer = start(runs)
    loop, statistics = trainer.loop, trainer.loop.experience.normalizer.statistics()
    observation, actions = np.ones(3, np.float32), []
    with until(trainer, "select"):
        states = jax.device_get(loop.learners.states)
        for params, explorer in zip(loop.learners.policy_params, loop.explorers, strict=True):
            assert same(params[0], states[1].actor)
            rng_k = copy.deepcopy(explorer.act_stream)
            actions.append(explorer.learner.act(params, (), observation, rng_k)[0])
        rows = loop.replays[0].sample(rng, (2, 16)).rows
        loop.learners.update([0], [UpdateInputs(99, rows, None, statistics)])
        after = jax.device_get(loop.learners.states)
    assert not np.any(actions[0] == actions[1])
    assert same(states[0], states[1])
    assert same(after[1], states[1])
    assert all_differ(after[0], states[0])


def test_ties_go_to_the_first(runs: Path) -> None:
    trainer = start(runs, returns=([4], [4]), steps=20, **IDLE)
    (row,) = select_rows(trainer)
    assert (row["parents"], row["champion"], row["gap"]) == ([0, 0], 0, 0)


@pytest.mark.parametrize(
    ("warmup", "first"), [(0, 20), (1, 40), (20, 40), (21, 60), (30, 60), (40, 60), (41, 80)]
)
def test_no_round_that_began_in_the_warmup_decides(warmup: int, first: int, runs: Path) -> None:
    """Rounds of 20 steps: the first selection ends the first round that began after it."""
    trainer = start(runs, warmup=warmup, steps=100, **IDLE)
    assert [row["step"] for row in select_rows(trainer)] == list(range(first, 101, 20))


def test_renaming_members_changes_only_names(runs: Path) -> None:
    """Whoever returns 5 against 3 wins by the same gap, however often the two change places."""
    winners = [1, 0, 0, 1, 0, 1]
    first, second = [3 + 2 * (w == 0) for w in winners], [3 + 2 * (w == 1) for w in winners]
    rows = select_rows(start(runs, returns=(first, second), **IDLE))
    assert [row["champion"] for row in rows] == winners
    assert [row["parents"] for row in rows] == [[w, w] for w in winners]
    for row in rows:
        assert row["gap"] == row["standard_error"] == 2


# What is copied.


SMALL: dict[str, Any] = {"crossq": {"critic_hidden": (8,)}}
SHARED = (*NETWORKS, "log_alpha")
KINDS = ("td3", "sac", "tqc", "crossq", "sunrise")


def of_kind(name: str) -> Any:
    return learner(name, **SMALL.get(name, {}))


@pytest.fixture
def states(rng: np.random.Generator) -> Any:
    """Three members, no two of whose numbers are alike, optimisers included."""
    return states_of("td3", rng)


def states_of(name: str, rng: np.random.Generator) -> Any:
    """Such members of an algorithm."""
    like = jax.eval_shape(of_kind(name).init, jax.random.key(0))
    return [
        jax.tree.map(lambda x: jnp.asarray(rng.uniform(1, 1e6, x.shape), x.dtype), like)
        for _ in range(3)
    ]


PARENTS = np.array([1, 1, 0])


def test_full_copy_takes_everything(states: Any) -> None:
    for new, parent in zip(
        copy_from_parents(learner(), states, PARENTS, "full"), PARENTS, strict=True
    ):
        assert same(new, states[parent])


@pytest.mark.parametrize("name", KINDS)
def test_copy_of_weights_leaves_everyone_their_optimiser(
    name: str, rng: np.random.Generator
) -> None:
    """Networks, targets and temperature are the parent's, moments and counter one's own."""
    states = states_of(name, rng)
    for k, new in enumerate(copy_from_parents(of_kind(name), states, PARENTS, "weights")):
        for part in states[k]._fields:
            source = PARENTS[k] if part in SHARED else k
            assert same(getattr(new, part), getattr(states[source], part)), part


@pytest.mark.parametrize("name", KINDS)
def test_copy_of_the_actor_starts_its_optimiser_anew(name: str, rng: np.random.Generator) -> None:
    """The parent's actor, as the target too, without moments; the rest is one's own."""
    states = states_of(name, rng)
    new = copy_from_parents(of_kind(name), states, PARENTS, "actor")
    for k, parent in [(0, 1), (2, 0)]:
        for part in states[k]._fields:
            found = getattr(new[k], part)
            if part in ("actor", "target_actor"):
                assert same(found, states[parent].actor)
            elif part == "actor_opt_state":
                assert jax.tree.structure(found) == jax.tree.structure(states[k].actor_opt_state)
                assert not any(np.any(x) for x in jax.tree.leaves(found))
            else:
                assert same(found, getattr(states[k], part)), part
    assert same(new[1], states[1])  # the winner itself is left as it is


@pytest.mark.parametrize("copy", ["full", "weights", "actor"])
def test_copying_does_not_depend_on_names(copy: str, states: Any) -> None:
    """Renaming members before or after the copy gives the same states; nobody shares a buffer."""
    copied = copy_from_parents(learner(), states, PARENTS, copy)
    for names in permutations(range(3)):
        order = np.array(names)
        renamed = np.argsort(order)[PARENTS[order]]
        one = copy_from_parents(learner(), [states[k] for k in order], renamed, copy)
        assert same(one, [copied[k] for k in order])
    buffers = [x.unsafe_buffer_pointer() for x in jax.tree.leaves(copied)]
    assert len(set(buffers)) == len(buffers)


def test_average_is_the_mean_of_the_better_half(states: Any) -> None:
    """Whole numbers, whose means are exact: floating-point leaves of members 2 and 0, counters of
    the best, for everyone; `weights` and `actor` take their part of it and leave the rest.
    """
    states = [jax.tree.map(lambda x: x.round() if x.dtype.kind == "f" else x, s) for s in states]
    parents, weights, *_ = choose(
        "average", np.array([[4.0], [1.0], [6.0]]), np.random.default_rng()
    )
    assert parents.tolist() == [2, 2, 2]
    expected = jax.tree.map(
        lambda one, best: (one + best) / 2 if best.dtype.kind == "f" else best, states[0], states[2]
    )
    for new in copy_from_parents(learner(), states, parents, "full", weights):
        assert same(new, expected)
    for own, new in zip(
        states, copy_from_parents(learner(), states, parents, "weights", weights), strict=True
    ):
        assert same(new.actor, expected.actor)
        assert same(new.critic_opt_state, own.critic_opt_state)
        assert same(new.updates, own.updates)
    for own, new in zip(
        states, copy_from_parents(learner(), states, parents, "actor", weights), strict=True
    ):
        assert same(new.target_actor, expected.actor)
        assert same(new.critic, own.critic)


def test_average_in_a_run(runs: Path) -> None:
    """Returns 3, 5 and 4: all members go on as the mean of members 1 and 2, the champion's place
    is the best one's, and no episode that another network began counts.
    """
    trainer = start(runs, members=3, rule="average", steps=120)
    apply, before = trainer.loop.apply, list[Any]()

    def watched(selection: Selection) -> None:
        before.extend(jax.device_get(trainer.loop.learners.states))
        apply(selection)

    trainer.loop.apply = watched
    with until(trainer, "select") as report:
        after = jax.device_get(trainer.loop.learners.states)
        assert (report.values["parents"], report.values["champion"]) == ([1, 1, 1], 1)
        assert report.values["weights"] == [[0, 0.5, 0.5]] * 3
        assert [member.copied for member in trainer.progress.members] == [30] * 3
    mean = jax.tree.map(lambda x, y: x * np.float32(0.5) + y * np.float32(0.5), *before[1:])
    for state in after:
        for part in NETWORKS:
            assert same(getattr(state, part), getattr(mean, part))


def test_rescue_copies_only_who_has_fallen(runs: Path) -> None:
    """Windows of five episodes: nobody, then member 0 alone, from the best, member 1."""
    returns = ([9] * 5 + [1, 2, 1, 2, 1], [10] * 5 + [11, 10, 11, 10, 11], [8] * 10)
    trainer = start(runs, returns, members=3, rule="rescue", steps=300)
    apply, held = trainer.loop.apply, list[Any]()

    def watched(selection: Selection) -> None:
        before = jax.device_get(trainer.loop.learners.states)
        apply(selection)
        held.append((before, jax.device_get(trainer.loop.learners.states)))

    trainer.loop.apply = watched
    rows = select_rows(trainer)
    assert [row["step"] for row in rows] == [150, 300]
    assert [row["parents"] for row in rows] == [[0, 1, 2], [1, 1, 2]]
    assert [row["champion"] for row in rows] == [1, 1]
    assert same(*held[0])
    before, after = held[1]
    assert same(after, [before[1], before[1], before[2]])


@pytest.mark.parametrize("window", [2, 3])
def test_rescue_looks_at_the_given_window(window: int, runs: Path) -> None:
    trainer = start(runs, rule="rescue", select_window=window, steps=60 * window, **IDLE)
    assert [len(row["returns"][0]) for row in select_rows(trainer)] == [window] * 3


def test_rescue_needs_two_episodes(runs: Path) -> None:
    with pytest.raises(UsageError, match=r"^select_window: .*at least 2 episodes, got 1$"):
        start(runs, rule="rescue", select_window=1)


# What a rule may change besides.


def explore(returns: Any, rng: np.random.Generator) -> Choice:
    """As PBT: the best one's state, and member 1 with half its critics' learning rate."""
    factors = np.where(np.arange(len(returns)) == 1, 0.5, 1.0)
    return Choice(np.full(len(returns), np.argmax(returns)), scales={RATE: factors})


RATE = "critic_learning_rate"


def test_a_rule_scales_learning_rates(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After two selections member 1 learns as a learner with a quarter of the rate, member 0 as
    before; factors are logged, and survive a stop.
    """
    monkeypatch.setitem(RULES, "best", explore)
    trainer = start(runs, returns=([3], [5]), steps=40, name="scaled")
    run_to_end(trainer)
    rows = [row for row in log(trainer.directory) if row["kind"] == "select"]
    assert [row["scales"] for row in rows] == [{RATE: [1, 0.5]}] * 2
    trainer = Trainer.resume(trainer.directory.path, steps=41)
    loop = trainer.loop
    scales = [member.scales for member in loop.progress.members]
    assert scales == [{RATE: 0.5}, {RATE: 0.25}]  # the winner, member 1, had half of it already
    rows, still = (
        loop.replays[0].padded(32).reshape(2, 16, -1),
        loop.experience.normalizer.statistics(),
    )
    hyper = loop.config.hyper
    for k, scale in enumerate((0.5, 0.25)):
        before = jax.tree.map(jnp.copy, loop.learners.states[k])
        inputs = UpdateInputs(7, rows, None, still, scales=scales[k])
        (found,) = loop.learners.update([k], [inputs])
        plain = learner(spec=loop.explorers[0].learner.spec)
        plain = replace(
            plain, hyper=replace(hyper, critic_learning_rate=hyper.critic_learning_rate * scale)
        )
        layout = loop.learners.compiled.layout
        apart = CompiledLearner(plain, layout, 0, False)
        expected = apart.update(before, k, UpdateInputs(7, rows, None, still))
        for one, other in zip(
            jax.tree.leaves(found.state), jax.tree.leaves(expected.state), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7)
    trainer.close()


def test_a_rule_may_only_scale_learning_rates(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def rule(returns: Any, rng: np.random.Generator) -> Choice:
        return Choice(np.arange(len(returns)), scales={"gamma": np.ones(len(returns))})

    monkeypatch.setitem(RULES, "best", rule)
    with pytest.raises(UsageError, match=r"cannot scale 'gamma'.*actor_learning_rate"):
        run_to_end(start(runs))


# Counting.


@pytest.mark.parametrize("steps", [40, 57, 61, 119])
def test_budget_is_met_exactly_in_the_middle_of_a_round(steps: int, runs: Path) -> None:
    """All members' steps add up to the budget, whoever would have been next."""
    trainer = start(runs, lengths=(10, 30), steps=steps, **IDLE)
    last = log(run_to_end(trainer))[-1]
    assert last["step"] == sum(last["member_steps"]) == steps
    assert last["selection_steps"] == 0


@pytest.mark.parametrize(("steps", "trials"), [(75, 25), (137, 77), (140, 80), (141, 80)])
def test_selection_episodes_are_counted(steps: int, trials: int, runs: Path) -> None:
    """Each trial of 2 x 2 episodes of 10 steps costs 40, or what is left of the budget."""
    trainer = start(runs, steps=steps, select_on="eval", select_every=50, select_window=2, **IDLE)
    last = log(run_to_end(trainer))[-1]
    assert last["step"] == sum(last["member_steps"]) + last["selection_steps"] == steps
    assert last["selection_steps"] == trials
    assert last["episodes"] == sum(last["member_steps"]) // 20 * 2  # trials train nobody


def test_selection_episodes_may_go_uncounted(runs: Path) -> None:
    """The members make the whole budget themselves; the ledger names the trials all the same."""
    eager: dict[str, Any] = {"select_on": "eval", "select_every": 50, "select_window": 2}
    trainer = start(runs, steps=140, count_selection_steps=False, **eager, **IDLE)
    last = log(run_to_end(trainer))[-1]
    assert last["step"] == sum(last["member_steps"]) == 140
    assert last["selection_steps"] == 80


@pytest.mark.parametrize(
    ("warmup", "after", "first"), [(0, None, 20), (0, 45, 80), (45, None, 80), (45, 0, 20)]
)
def test_selection_begins_with_a_round_after_its_own_time(
    warmup: int, after: int | None, first: int, runs: Path
) -> None:
    """Rounds of 20 steps count if they began at `select_after` or later, by default the warm-up."""
    trainer = start(runs, lengths=(10, 10), warmup=warmup, select_after=after)
    assert select_rows(trainer)[0]["step"] == first


def test_trials_begin_after_their_own_time(runs: Path) -> None:
    """With `select_after` 60 and one each 50 steps, the first is at 100."""
    trainer = start(runs, select_on="eval", select_every=50, select_after=60, steps=200, **IDLE)
    assert select_rows(trainer)[0]["step"] == 120  # and its two episodes


def test_selection_on_trials_chooses_by_their_mean(runs: Path) -> None:
    """By the trials' returns, not by training's; a selection cut short decides nothing."""
    trainer = start(
        runs, returns=([9], [0]), steps=130, select_on="eval", select_every=50, select_window=2
    )
    trainer.loop.selector.trial_env = Environment(Recipe(ENV), 0, Stream.SELECT)
    script(trainer.loop.selector.trial_env, returns=[1, 3, 5, 9])
    (row,) = select_rows(trainer)
    assert (row["step"], row["returns"]) == (90, [[1, 3], [5, 9]])
    assert (row["parents"], row["champion"]) == ([1, 1], 1)


def test_waiting_members_neither_step_nor_learn(runs: Path) -> None:
    """Rounds of 10 and 30 steps: the first member's arrays rest while the second goes on."""
    trainer = start(runs, lengths=(10, 30), rule="none", steps=125)
    learn, rests = trainer.loop.learn, 0
    steps = [0, 0]

    def watched() -> None:
        nonlocal rests, steps
        before = jax.device_get(trainer.loop.learners.states)
        learn()
        after = jax.device_get(trainer.loop.learners.states)
        old, steps = steps, [each.steps for each in trainer.progress.members]
        for k in (0, 1):
            if steps[k] == old[k]:
                assert same(before[k], after[k])
                rests += 1

    trainer.loop.learn = watched
    run_to_end(trainer)
    assert steps == [33, 92]
    assert rests >= 60
    due = [each.updates_due for each in trainer.progress.members]
    updates = [int(state.updates) for state in trainer.loop.learners.states]
    np.testing.assert_array_equal(np.add(updates, due), steps)


def test_counting_each_member(runs: Path) -> None:
    """60 steps a member are 120 in all, and evaluations fall due twice as late."""
    trainer = start(runs, count="member", steps=60, eval_every=20, **IDLE)
    rows = log(run_to_end(trainer))
    assert [row["step"] for row in rows if row["kind"] == "eval"] == [0, 40, 80, 120]
    assert rows[-1]["member_steps"] == [60, 60]


def test_without_waiting_the_quick_member_goes_on(runs: Path) -> None:
    """Three short episodes fit beside a long one; the latest of each decides."""
    trainer = start(runs, returns=([1, 2, 3], [9]), lengths=(10, 30), wait=False, **IDLE)
    rows = select_rows(trainer)
    assert [row["step"] for row in rows] == [60, 120]
    assert [row["returns"] for row in rows] == [[[3], [9]]] * 2
    assert rows[-1]["member_steps"] == [60, 60]


def test_an_episode_counts_for_the_weights_that_played_it(runs: Path) -> None:
    """Member 0 loses at step 24, within its second episode, which then decides nothing: at 48, when
    member 1 ends again, the third one is awaited.
    """
    trainer = start(runs, returns=([5], [9]), lengths=(10, 12), wait=False, **IDLE)
    rows = select_rows(trainer)
    assert [row["step"] for row in rows][:2] == [24, 60]


def test_window_takes_the_mean_of_its_episodes(runs: Path) -> None:
    """A selection every second round, on those two rounds; gap and error by hand."""
    trainer = start(runs, returns=([1, 3], [9, 5]), select_window=2, **IDLE)
    rows = select_rows(trainer)
    assert [row["step"] for row in rows] == [40, 80, 120]
    for row in rows:
        assert row["returns"] == [[1, 3], [9, 5]]
        assert row["gap"] == 5  # 7 - 2
        np.testing.assert_allclose(row["standard_error"], 5**0.5)  # variances 2 and 8, n = 2


# The gap and its error.


def test_error_of_single_episodes_pools_the_last_selections() -> None:
    """Returns (3, 5) have variance 2, (4, 4) have 0: errors sqrt(2 * 2), then sqrt(2 * 1)."""
    variances: list[float] = []
    first = measure(np.array([[3.0], [5.0]]), variances, False)
    assert first == (2, 2)
    gap, error = measure(np.array([[4.0], [4.0]]), variances, False)
    assert gap == 0
    np.testing.assert_allclose(error, 2**0.5)


def test_error_forgets_after_twenty_selections() -> None:
    variances: list[float] = []
    measure(np.array([[0.0], [1000.0]]), variances, False)
    for _ in range(POOLED_SELECTIONS):
        last = measure(np.array([[3.0], [5.0]]), variances, False)
    assert POOLED_SELECTIONS == len(variances) == 20
    assert last == (2, 2)


def test_error_of_paired_episodes_leaves_out_their_starts() -> None:
    """Differences 4 and 6: variance 2, so an error of 1; what a start gives to all is no noise."""
    returns = np.array([[1.0, 3.0], [5.0, 9.0]])
    assert measure(returns, [], True) == (5, 1)
    assert measure(returns + np.array([0.0, 100.0]), [], True) == (5, 1)
    assert measure(returns, [], False) == (5, 5**0.5)  # variances 2 and 8, n = 2


def test_gap_is_to_the_second_best() -> None:
    assert measure(np.array([[1.0, 3.0], [9.0, 5.0], [6.0, 6.0]]), [], False)[0] == 1


# Rules that are controls.


def test_random_rule_is_a_placebo(runs: Path) -> None:
    """With the returns exchanged it chooses the same members, and each of them sometimes."""
    chosen: list[Any] = []
    for name, returns in (("one", ([3], [5])), ("other", ([5], [3]))):
        trainer = start(runs, returns, name=name, rule="random", steps=240, **IDLE)
        chosen.append([row["parents"] for row in select_rows(trainer)])
    assert chosen[0] == chosen[1]
    assert len(chosen[0]) == 12
    assert {tuple(parents) for parents in chosen[0]} == {(0, 0), (1, 1)}


def test_rule_none_copies_nobody_and_evaluates_all(runs: Path) -> None:
    """Member 0 stays the champion; the last evaluation tells how everyone did."""
    trainer = start(runs, rule="none", members=2, eval_every=50)
    rows = log(run_to_end(trainer))
    evaluations = [row for row in rows if row["kind"] == "eval"]
    assert [len(row.get("members", [])) for row in evaluations] == [0, 0, 0, 2]
    assert {row["champion"] for row in rows if "champion" in row} == {0}
    assert all(row["parents"] == [0, 1] for row in rows if row["kind"] == "select")
    states = jax.device_get(trainer.loop.learners.states)
    for part in NETWORKS:
        assert all_differ(*(getattr(state, part) for state in states))


# What members share, and what keeps them apart.


def test_members_begin_apart(runs: Path) -> None:
    """No array of a member's networks is another's, before anybody has learned."""
    trainer = start(runs, **IDLE)
    with until(trainer, "eval"):
        states = jax.device_get(trainer.loop.learners.states)
    for part in NETWORKS:
        assert all_differ(*(getattr(state, part) for state in states))


def test_clones_do_not_stay_clones(runs: Path) -> None:
    """Members that begin alike, without target noise, part by their own minibatches alone."""
    trainer = start(runs, same_init=True, rule="none", target_noise=0.0, steps=20)
    update, batches = trainer.loop.learners.compiled.update, []

    def watched(state: Any, member: int, inputs: UpdateInputs) -> Any:
        batches.append(inputs.rows)
        return update(state, member, inputs)

    trainer.loop.learners.compiled.update = watched
    with until(trainer, "eval"):
        states = jax.device_get(trainer.loop.learners.states)
        assert same(*states)
    trainer = Trainer.resume(trainer.directory.path)
    trainer.loop.learners.compiled.update = watched
    run_to_end(trainer)
    assert len(batches) == 10
    assert not any(np.array_equal(*pair) for pair in zip(batches[::2], batches[1::2], strict=True))
    states = jax.device_get(trainer.loop.learners.states)
    for part in NETWORKS:
        assert all_differ(*(getattr(state, part) for state in states))


def test_members_at_the_same_time_learn_as_one_after_the_other(runs: Path) -> None:
    """Threads change nothing: the states equal those of a run whose members take turns."""
    states: list[Any] = []
    for name in ("together", "in-turn"):
        trainer = start(runs, name=name, members=3, rule="none", steps=90, replay="prioritized")
        loop = trainer.loop
        if name == "in-turn":
            loop.learners.workers = SimpleNamespace(map=map, shutdown=lambda: None)
        run_to_end(trainer)
        states.append(jax.device_get(loop.learners.states))
    assert same(*states)


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_clones_on_one_minibatch_part_by_their_keys(
    noise: float, runs: Path, rng: np.random.Generator
) -> None:
    """The same rows for both: equal without target noise, apart with it."""
    trainer = start(runs, same_init=True, target_noise=noise)
    loop = trainer.loop
    rows = rng.normal(size=(2, 16, loop.learners.compiled.layout.width)).astype(np.float32)
    update, statistics = loop.learners.compiled.update, loop.experience.normalizer.statistics()
    inputs = UpdateInputs(0, rows, None, statistics)
    moved = [update(loop.learners.states[k], k, inputs).state for k in (0, 1)]
    moved = jax.device_get(moved)
    trainer.close()
    assert same(*moved) == (noise == 0)


class Told(NamedTuple):
    key: Any


class KeyTeller(Learner):
    """A learner that learns nothing and tells the key and the observations it is given."""

    def init(self, key: Any) -> Told:
        return Told(jax.random.key_data(key))

    def policy_params(self, state: Told) -> Any:
        return state.key

    def update(self, state: Told, batch: Any, key: Any) -> Update:
        seen = jnp.concatenate([batch.observation, batch.next_observation], axis=-1)
        return Update(Told(jax.random.key_data(key)), {"loss": jnp.zeros(())}, seen)


STILL = np.zeros(3, np.float32), np.ones(3, np.float32)


def test_no_two_draws_of_a_run_share_a_key() -> None:
    """Every member's init and every cycle of it, also where the next block of keys is made; each
    is the run's key with its purpose, its cycle and its member folded in.
    """
    layout = Layout(SPEC)
    compiled = CompiledLearner(KeyTeller(), layout, seed=0, normalize=False)
    rows = np.zeros((1, 1, layout.width), np.float32)
    states = compiled.init(3, same=False)
    told = [tuple(np.asarray(state.key)) for state in states]
    cycles = [0, 1, 2, KEYS - 1, KEYS, KEYS + 1, 5 * KEYS + 3]
    for cycle in cycles:
        for k, state in enumerate(states):
            states[k] = compiled.update(state, k, UpdateInputs(cycle, rows, None, STILL)).state
            folded = jax.random.fold_in(jax.random.key(0), KeyUse.UPDATE)
            folded = jax.random.fold_in(jax.random.fold_in(folded, cycle), k)
            assert np.array_equal(states[k].key, jax.random.key_data(folded))
        told += [tuple(np.asarray(state.key)) for state in states]
    assert len(set(told)) == len(told) == 3 * (1 + len(cycles))


def test_keys_stay_of_their_kind_whatever_the_default_is_later() -> None:
    layout = Layout(SPEC)
    with jax.default_prng_impl("rbg"):
        compiled = CompiledLearner(KeyTeller(), layout, seed=0, normalize=False)
        state = compiled.init(1, same=False)[0]
    rows = np.zeros((1, 1, layout.width), np.float32)
    key = compiled.update(state, 0, UpdateInputs(0, rows, None, STILL)).state.key
    assert key.shape == state.key.shape == (4,)


def test_members_learn_from_observations_as_they_act_on_them(rng: np.random.Generator) -> None:
    """Raw rows are scaled for the learner as an observation is for acting, cut at +-10."""
    layout = Layout(SPEC)
    compiled = CompiledLearner(KeyTeller(), layout, seed=0, normalize=True)
    rows = rng.normal(size=(1, 3, layout.width), scale=20).astype(np.float32)
    statistics = np.array([3, -2, 0], np.float32), np.array([2, 0.5, 7], np.float32)
    (state,) = compiled.init(1, same=True)
    inputs = UpdateInputs(0, rows, None, statistics)
    seen = np.asarray(compiled.update(state, 0, inputs).td_error[0])
    batch = layout.unpack(rows[0])
    raw = np.stack([batch.observation, batch.next_observation], axis=1)
    assert np.abs(seen).max() == 10
    np.testing.assert_allclose(seen.reshape(3, 2, 3), normalize(raw, *statistics), rtol=1e-6)


@pytest.mark.parametrize("scope", ["shared", "member"])
def test_replay_scope_says_whose_rows_a_replay_holds(scope: str, runs: Path) -> None:
    """One replay with everybody's rows in turn, or each member's own rows only."""
    trainer = start(runs, replay_scope=scope, **IDLE)
    with until(trainer, "select"):
        marks = [replay.rows[: replay.head, 0].tolist() for replay in trainer.loop.replays]
    assert marks == ([[0, 1] * 10] if scope == "shared" else [[0] * 10, [1] * 10])


def test_members_learn_from_the_rows_of_their_scope(runs: Path) -> None:
    """With replays of their own, a member's minibatches hold its rows alone."""
    for scope, expected in (("member", {(0, 0), (1, 1)}), ("shared", None)):
        trainer = start(runs, replay_scope=scope, name=scope, rule="none", steps=60)
        update, seen = trainer.loop.learners.compiled.update, set()

        def watched(
            state: Any, k: int, inputs: UpdateInputs, to: Any = update, into: Any = seen
        ) -> Any:
            into |= {(k, mark) for mark in inputs.rows[..., 0].ravel()}
            return to(state, k, inputs)

        trainer.loop.learners.compiled.update = watched
        run_to_end(trainer)
        assert seen == (expected or {(0, 0), (0, 1), (1, 0), (1, 1)})


# Repeating, and not disturbing.


def test_evaluations_do_not_disturb_training(runs: Path) -> None:
    """However often and long they are, learners, replay, envs and streams end the same."""
    settings: dict[str, Any] = {"normalize_observation": True, "steps": 100}
    often = start(runs, name="often", eval_every=7, eval_episodes=3, **settings)
    rarely = start(runs, name="rarely", eval_every=1000, **settings)
    one, other = (content(run_to_end(trainer)) for trainer in (often, rarely))
    assert sum(row["kind"] == "eval" for row in one["log"]) > 10
    assert same(one["arrays"], other["arrays"])
    for part in ("states", "replay.0", "env.0", "env.1"):
        assert one["table"][part] == other["table"][part]


def test_training_selection_and_evaluation_never_share_a_start(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evaluations repeat their starts; selections take new ones, the same for all members."""
    used: dict[Stream, list[int]] = {}

    def recorded(seed: int, stream: Stream, index: int, episode: int) -> int:
        found = episode_seed(seed, stream, index, episode)
        used.setdefault(stream, []).append(found)
        return found

    monkeypatch.setattr(environment, "episode_seed", recorded)
    more = {"select_every": 60, "select_window": 2, "eval_every": 60, "eval_episodes": 3}
    trainer = start(runs, select_on="eval", steps=300, **more)
    kinds = [row["kind"] for row in log(run_to_end(trainer))]
    trials, evaluations = kinds.count("select"), kinds.count("eval")
    train, select, evaluate = (
        used[stream] for stream in (Stream.TRAIN, Stream.SELECT, Stream.EVALUATE)
    )
    assert not set(train) & set(select)
    assert not set(train) & set(evaluate)
    assert not set(select) & set(evaluate)
    assert evaluations >= 2
    assert evaluate == evaluate[:3] * (3 * evaluations)  # the champion and two mean actions
    assert len(set(evaluate)) == 3
    assert trials >= 2
    rounds = np.reshape(select[: trials * 4], (trials, 2, 2))
    np.testing.assert_array_equal(rounds[:, 0], rounds[:, 1])
    assert len(np.unique(rounds)) == 2 * trials
    assert len(set(train[1:])) == len(train) - 1  # the check before training enters one twice


STARTS = [Stream.TRAIN, Stream.SELECT, Stream.EVALUATE, Stream.REPORT]


@given(
    seed=st.integers(0, 2**32 - 1),
    streams=st.lists(st.sampled_from(STARTS), min_size=2, max_size=2, unique=True),
    places=st.lists(st.integers(0, 2**20), min_size=4, max_size=4),
)
def test_streams_never_share_a_start(seed: int, streams: list[Stream], places: list[int]) -> None:
    """Whatever members and episodes they are at, since even the low bits of the seeds differ."""
    one, other = streams
    a, b, c, d = places
    first, second = episode_seed(seed, one, a, b), episode_seed(seed, other, c, d)
    assert first % 8 != second % 8
    assert 0 <= first < 2**32


def test_the_seed_decides_everything(runs: Path) -> None:
    """The same seed twice gives the same run to the last bit, another one another."""
    first, again, other = (
        run_to_end(start(runs, name=name, seed=seed, steps=60))
        for name, seed in (("first", 1), ("again", 1), ("other", 2))
    )
    assert_same(first, again)
    assert not same(
        content(first)["arrays"]["states.0.actor.0.kernel"],
        content(other)["arrays"]["states.0.actor.0.kernel"],
    )

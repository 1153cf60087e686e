"""Every rule, for any returns: who stays, who starts again from whom, and what cannot matter."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pacesetter.ensemble.rules import RULES, choose

RETURNS = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=9).map(np.array)
TIED = st.lists(st.integers(0, 2).map(float), min_size=1, max_size=9).map(np.array)
DISTINCT = st.lists(st.integers(-50, 50), min_size=1, max_size=9, unique=True).map(
    lambda values: np.array(values, float)
)
SEEDS = st.integers(0, 2**32)


def window(returns: Any) -> Any:
    """Two like episodes of each member, so that `rescue` has a spread, which is none."""
    return np.stack([returns, returns], axis=1)


def parents_of(rule: str, returns: Any, seed: int = 0) -> list[int]:
    return choose(rule, window(returns), np.random.default_rng(seed)).parents.tolist()


@pytest.mark.parametrize("rule", RULES)
@given(returns=RETURNS | TIED, seed=SEEDS)
def test_parents_are_members_and_returns_stay(rule: str, returns: Any, seed: int) -> None:
    """One parent a member, each a member, and the returns are not written to."""
    episodes = window(returns)
    before = episodes.copy()
    parents = choose(rule, episodes, np.random.default_rng(seed)).parents
    assert parents.shape == returns.shape
    assert np.issubdtype(parents.dtype, np.integer)
    assert parents.min() >= 0
    assert parents.max() < len(returns)
    np.testing.assert_array_equal(episodes, before)


@pytest.mark.parametrize("rule", RULES)
@given(seed=SEEDS, value=st.floats(-1e6, 1e6))
def test_one_member_starts_from_itself(rule: str, seed: int, value: float) -> None:
    assert parents_of(rule, np.array([value]), seed) == [0]


@given(returns=RETURNS | TIED)
def test_none_moves_nobody(returns: Any) -> None:
    assert parents_of("none", returns) == list(range(len(returns)))


@given(returns=RETURNS | TIED)
def test_best_is_the_first_of_the_largest(returns: Any) -> None:
    values = returns.tolist()
    assert parents_of("best", returns) == [values.index(max(values))] * len(values)


@given(returns=RETURNS, others=st.data(), seed=SEEDS)
def test_random_is_blind_and_one_for_all(returns: Any, others: st.DataObject, seed: int) -> None:
    """Whatever the returns, the same generator gives the same single parent."""
    shuffled = np.array(others.draw(st.permutations(returns.tolist())))
    parents = parents_of("random", returns, seed)
    assert parents == parents_of("random", shuffled, seed)
    assert len(set(parents)) == 1


def test_random_draws_every_member_equally() -> None:
    """4000 draws among 4: each count within 5 standard errors of 1000."""
    rng = np.random.default_rng(0)
    drawn = [int(RULES["random"](window(np.arange(4.0)), rng)[0]) for _ in range(4000)]
    assert np.all(np.abs(np.bincount(drawn, minlength=4) - 1000) < 5 * (4000 * 3 / 16) ** 0.5)


@given(returns=RETURNS | TIED)
def test_top_half_keeps_the_better_half(returns: Any) -> None:
    """Ranked with ties to the lowest index, rank r of the worse half starts from rank r - half."""
    count = len(returns)
    ranked = sorted(range(count), key=lambda k: (-returns[k], k))
    half = -(-count // 2)
    parents = parents_of("top_half", returns)
    for rank, k in enumerate(ranked):
        assert parents[k] == (k if rank < half else ranked[rank - half])


@given(returns=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=2).map(np.array))
def test_top_half_of_two_is_best(returns: Any) -> None:
    assert parents_of("top_half", returns) == parents_of("best", returns)


@given(returns=RETURNS | TIED, seed=SEEDS)
def test_tournament_is_won_by_the_better_of_two(returns: Any, seed: int) -> None:
    """Played again by hand with the same draws; ties go to the lower index."""
    pairs = np.random.default_rng(seed).integers(len(returns), size=(len(returns), 2)).tolist()
    expected = [min(pair, key=lambda k: (-returns[k], k)) for pair in pairs]
    assert parents_of("tournament", returns, seed) == expected


def test_tournament_favours_the_better_by_known_odds() -> None:
    """Among 3, the best wins 5 of 9 places, the next 3, the worst 1; 5 standard errors."""
    rng = np.random.default_rng(0)
    places = np.concatenate(
        [RULES["tournament"](window(np.array([1.0, 3, 2])), rng) for _ in range(3000)]
    )
    for k, odds in ((1, 5 / 9), (2, 3 / 9), (0, 1 / 9)):
        assert abs(np.mean(places == k) - odds) < 5 * (odds * (1 - odds) / 9000) ** 0.5


@pytest.mark.parametrize("rule", ["none", "best", "top_half"])
@given(returns=DISTINCT, order=st.data())
def test_renaming_members_renames_parents(rule: str, returns: Any, order: st.DataObject) -> None:
    """For distinct returns a permutation of the members permutes the choice and nothing else."""
    names = order.draw(st.permutations(range(len(returns))))
    parents = parents_of(rule, returns)
    renamed = parents_of(rule, returns[list(names)])
    assert [names[parent] for parent in renamed] == [parents[name] for name in names]


@pytest.mark.parametrize("rule", [rule for rule in RULES if rule != "rescue"])
@given(returns=DISTINCT, shift=st.integers(-1000, 1000), scale=st.sampled_from([0.5, 1, 64]))
def test_only_the_order_of_returns_counts(rule: str, returns: Any, shift: int, scale: Any) -> None:
    assert parents_of(rule, returns, 5) == parents_of(rule, scale * returns + shift, 5)


@given(returns=RETURNS | TIED)
def test_average_weights_the_better_half_alike(returns: Any) -> None:
    """Everyone's row: 1 / half for the half that `top_half` keeps, else 0; the best is parent."""
    count, half = len(returns), -(-len(returns) // 2)
    parents, weights, scales, _ = choose("average", window(returns), np.random.default_rng(0))
    assert weights is not None
    assert scales is None
    kept = np.flatnonzero(
        choose("top_half", window(returns), np.random.default_rng(0)).parents == np.arange(count)
    )
    assert parents.tolist() == parents_of("best", returns)
    for row in weights:
        assert np.flatnonzero(row).tolist() == kept.tolist()
        assert set(row[kept]) == {1 / half}


@given(returns=st.permutations(range(10)), seed=SEEDS)
def test_pbt_moves_the_worst_fifth_to_the_best_fifth(returns: Any, seed: int) -> None:
    """Of ten members exactly the two worst, and only they are perturbed."""
    rng = np.random.default_rng(seed)
    parents, _, _, perturb = choose("pbt", window(np.array(returns, float)), rng)
    assert perturb is not None
    for k, value in enumerate(returns):
        assert perturb[k] == (value < 2)
        assert (returns[parents[k]] >= 8) if value < 2 else (parents[k] == k)


def test_pbt_draws_both_of_the_best_fifth() -> None:
    """Each of the two worst draws on its own: 4 outcomes, each in a quarter of 2000 draws."""
    rng, returns = np.random.default_rng(0), window(np.arange(10.0))
    drawn = [tuple(choose("pbt", returns, rng).parents[:2].tolist()) for _ in range(2000)]
    for pair in ((8, 8), (8, 9), (9, 8), (9, 9)):
        assert abs(drawn.count(pair) - 500) < 5 * (2000 * 3 / 16) ** 0.5


@pytest.mark.parametrize("rule", [rule for rule in RULES if rule not in ("random", "rescue")])
@given(returns=DISTINCT, order=st.data())
def test_means_of_the_window_decide(rule: str, returns: Any, order: st.DataObject) -> None:
    """Episodes that differ by 1 around each mean choose as the means do."""
    episodes = returns[:, None] + np.array([-1.0, 0, 1])
    assert choose(rule, episodes, np.random.default_rng(3)).parents.tolist() == parents_of(
        rule, returns, 3
    )


# Rescue.

STEADY = np.array([-1.0, 1, 0, -1, 1])  # variance 1, so a difference has an error of sqrt(2 / 5)


@pytest.mark.parametrize(
    ("means", "parents"),
    [
        ([100, 61, 59], [0, 1, 0]),
        ([59, 100, 100], [1, 1, 2]),
        ([-100, -139, -141], [0, 1, 0]),
        ([10, 3, -500], [0, 0, 0]),
        ([1, 0.5, 0.1], [0, 1, 2]),  # below 60%, but within two errors, 1.26
        ([1, -0.2, -0.3], [0, 1, 0]),
        ([0, -1.2, -1.3], [0, 1, 0]),
    ],
)
def test_rescue_takes_who_lies_far_below(means: list[float], parents: list[int]) -> None:
    """Below 60% of the best, or 40% of its size below it where it is negative, and two errors."""
    returns = np.array(means)[:, None] + STEADY
    assert choose("rescue", returns, np.random.default_rng(0)).parents.tolist() == parents


def test_rescue_leaves_who_only_swings() -> None:
    """A mean of 51 against 100 is chance with an error of 28, and none without."""
    returns = np.array([[100.0] * 5, [0, 120, 0, 120, 15]])
    assert choose("rescue", returns, np.random.default_rng(0)).parents.tolist() == [0, 1]
    returns[1] = 51
    assert choose("rescue", returns, np.random.default_rng(0)).parents.tolist() == [0, 0]


@given(returns=RETURNS, factor=st.sampled_from([0.25, 2, 64]))
def test_rescue_does_not_depend_on_the_unit_of_reward(returns: Any, factor: float) -> None:
    spread = returns[:, None] + np.abs(returns).max() * STEADY
    found = [
        choose("rescue", unit * spread, np.random.default_rng(0)).parents.tolist()
        for unit in (1, factor)
    ]
    assert found[0] == found[1]

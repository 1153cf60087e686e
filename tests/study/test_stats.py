"""Statistics against hand-computed values, published numbers and independent forms."""

import math
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from scipy import stats as scipy_stats

from pacesetter.study.compare import stats

scipy: Any = scipy_stats
ONE = np.array([1.0, 4.0, 9.0, 16.0, 25.0, 36.0, 49.0, 64.0])


def numbers(*values: float) -> stats.Array:
    return np.array(values, dtype=float)


def test_final_is_the_last_tenth_and_at_least_three() -> None:
    steps = np.arange(0, 1_000_001, 5_000.0)
    returns = np.arange(len(steps), dtype=float)
    assert stats.final(steps, returns, 1_000_000) == np.mean(range(181, 201))  # above 900,000
    assert stats.final(steps[:21], returns[:21], 100_000) == np.mean([18, 19, 20])


def test_area_is_the_mean_of_training() -> None:
    assert stats.area(numbers(0, 10, 40), numbers(0, 2, 8)) == (10 * 1 + 30 * 5) / 40


def test_reached_is_the_first_evaluation_at_the_level() -> None:
    steps, returns = numbers(0, 5, 10, 15), numbers(-1, 1000, 900, 2500)
    assert stats.reached(steps, returns, 1_000) == 5
    assert stats.reached(steps, returns, 2_000) == 15
    assert stats.reached(steps, returns, 3_000) == math.inf


def test_smoothing_keeps_cubics_and_short_curves() -> None:
    x = np.linspace(-1, 1, 30)
    assert stats.smooth(x**3 - x, 11) == pytest.approx(x**3 - x)
    np.testing.assert_array_equal(stats.smooth(numbers(1, 5, 2), 11), [1, 5, 2])
    rough = np.tile([0.0, 1.0], 15)
    assert np.ptp(stats.smooth(rough, 11)[5:-5]) < 0.5 < np.ptp(rough)


@pytest.mark.parametrize(("points", "window", "used"), [(30, 9, 9), (8, 11, 7), (7, 11, 7)])
def test_smoothing_is_a_cubic_fit_around_each_point(points: int, window: int, used: int) -> None:
    """By least squares; a curve shorter than the window has the largest odd one that fits."""
    values, half = np.random.default_rng(2).normal(size=points), used // 2
    expected: list[float] = []
    for at in range(points):
        first = min(max(at - half, 0), points - used)  # at the ends the last whole window counts
        places = np.arange(first, first + used)
        expected.append(np.polyval(np.polyfit(places - at, values[places], 3), 0))
    assert stats.smooth(values, window) == pytest.approx(np.array(expected))


def test_mean_has_students_interval() -> None:
    # Student's t for 2 degrees of freedom is 4.30265; the deviation of 1, 2, 3 is 1.
    found = stats.mean(numbers(1, 2, 3))
    assert found.value == 2
    assert found.high - 2 == pytest.approx(4.302652729911275 / math.sqrt(3))
    assert found.low + found.high == pytest.approx(4)
    assert math.isnan(stats.mean(numbers(5)).low)
    assert stats.mean(numbers(5, 5)) == (5, 5, 5)


def test_band_is_the_mean_interval_at_each_point() -> None:
    curves = np.array([[1.0, 4.0], [2.0, 4.0], [3.0, 10.0]])
    middle, low, high = stats.band(curves)
    for point in range(2):
        expected = stats.mean(curves[:, point])
        assert (middle[point], low[point], high[point]) == pytest.approx(tuple(expected))
    assert np.isnan(stats.band(curves[:1])[1]).all()


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    assert stats.iqm([ONE]).value == np.mean([9, 16, 25, 36])
    assert stats.iqm([ONE[:4], ONE[4:]]).value == np.mean([9, 16, 25, 36])
    assert stats.iqm([numbers(1, 2, 6)]).value == 3  # of three nothing is cut, as in rliable


def test_iqm_of_several_tasks_is_resampled_within_each() -> None:
    """Two tasks whose runs are all alike have no spread, however far apart the tasks are."""
    flat, far = np.zeros(10), np.full(10, 100.0)
    assert stats.iqm([flat, far]) == (50, 50, 50)
    noisy = np.random.default_rng(1).normal(size=(3, 10))
    found = stats.iqm(list(noisy))
    rng = np.random.default_rng(7)
    draws = np.concatenate([task[rng.integers(10, size=(20_000, 10))] for task in noisy], axis=1)
    expected = np.quantile(scipy.trim_mean(draws, 0.25, axis=1), [0.025, 0.975])
    assert [found.low, found.high] == pytest.approx(expected, abs=0.02)


def test_few_seeds_get_no_bootstrap_interval() -> None:
    few = numbers(1, 2, 3, 4)
    assert math.isnan(stats.iqm([few]).low)
    assert math.isnan(stats.improvement([(few, ONE)]).low)
    assert np.isnan(stats.profile([few], few)[1]).all()
    nine, ten = np.arange(9.0), np.arange(10.0)
    for tasks in ([nine], [nine, nine]):
        assert math.isnan(stats.iqm(tasks).low)
    for tasks in ([ten], [ten, ten]):
        assert not math.isnan(stats.iqm(tasks).low)
    assert math.isnan(stats.improvement([(nine, nine)]).low)
    three, far = np.arange(3.0), np.arange(3.0) + 1.5
    assert math.isnan(stats.improvement([(three, far)] * 3).low), "nine runs a side"
    assert not math.isnan(stats.improvement([(three, far)] * 4).low), "twelve, over four tasks"
    assert np.isnan(stats.profile([nine], nine)[1]).all()
    found = stats.iqm([ten])
    assert found.low < found.value < found.high


def test_improvement_is_mann_whitneys_u() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.integers(0, 6, 12).astype(float), rng.integers(0, 6, 10).astype(float)
    u = scipy.mannwhitneyu(x, y).statistic / (12 * 10)
    found = stats.improvement([(x, y)])
    assert found.value == pytest.approx(u)
    assert stats.improvement([(y, x)]).value == pytest.approx(1 - u)
    assert stats.improvement([(x, y), (y, x)]).value == pytest.approx(0.5)
    assert 0 <= found.low < found.value < found.high <= 1


def test_improvement_without_a_lost_pair_gets_no_interval() -> None:
    """Resampling would give 1 each time, which is no certainty."""
    found = stats.improvement([(np.arange(10.0) + 100, np.arange(10.0))])
    assert found.value == 1
    assert math.isnan(found.low)


def test_improvement_interval_equals_one_drawn_run_by_run() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.normal(0.5, 1, 12), rng.normal(0, 1, 10)
    a = x[rng.integers(12, size=(20_000, 12))]
    b = y[rng.integers(10, size=(20_000, 10))]
    expected = np.quantile((a[:, :, None] > b[:, None]).mean(axis=(1, 2)), [0.025, 0.975])
    found = stats.improvement([(x, y)])
    assert [found.low, found.high] == pytest.approx(expected, abs=0.025)


def test_profile_is_the_share_of_runs_above() -> None:
    twice = np.repeat(ONE, 2)
    value, low, high = stats.profile([twice, twice + 1], numbers(0, 16, 64.5, 99))
    np.testing.assert_allclose(value, [1, (4 / 8 + 5 / 8) / 2, 1 / 16, 0])
    assert low[0] == high[0] == 1
    assert low[1] < value[1] < high[1]


def test_difference_without_an_interval() -> None:
    """One run on a side has no variance; equal runs on both sides leave no doubt."""
    assert math.isnan(stats.difference(np.ones(1), np.arange(3.0)).low)
    assert stats.difference(np.ones(3), np.zeros(3)) == (1, 1, 1)


@pytest.mark.parametrize("seed", range(5))
def test_welchs_interval_by_its_formula(seed: int) -> None:
    """Also where all runs of one group are alike; SciPy's warning about that is not passed on."""
    rng = np.random.default_rng(seed)
    x = rng.normal(4_000, 300, 3 + seed)
    for y in (rng.normal(3_500, 50, 7), np.full(4, 3_500.0)):
        a, b = x.var(ddof=1) / len(x), y.var(ddof=1) / len(y)
        freedom = (a + b) ** 2 / (a**2 / (len(x) - 1) + b**2 / (len(y) - 1))
        half = (a + b) ** 0.5 * scipy.t.ppf(0.975, freedom)
        gap = x.mean() - y.mean()
        expected = (gap, gap - half, gap + half)
        assert stats.difference(x, y) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("mean", "deviation", "seeds"),
    [
        (9533, 863, [14, 5, 3]),  # HalfCheetah
        (4565, 581, [27, 8, 5]),  # Walker2d
        (4185, 984, [88, 23, 11]),  # Ant
        (3305, 232, [9, 4, 3]),  # Hopper
    ],
)
def test_seeds_needed_for_10_20_30_percent_of_td3s_own_curves(
    mean: float, deviation: float, seeds: list[int]
) -> None:
    """Deviations of the last ten evaluations of TD3's ten published seeds."""
    gaps = [0.1 * mean, 0.2 * mean, 0.3 * mean]
    assert [stats.seeds_needed(gap, (deviation, deviation)) for gap in gaps] == seeds


def test_power_is_what_simulated_tests_find() -> None:
    rng = np.random.default_rng(5)
    x, y = rng.normal(1, 1, (20_000, 8)), rng.normal(0, 1, (20_000, 8))
    found = (scipy.ttest_ind(x, y, axis=1).pvalue < 0.05).mean()
    assert stats.power(8, 1.0, (1.0, 1.0)) == pytest.approx(found, abs=0.01)
    assert stats.power(8, 0.0, (1.0, 1.0)) == pytest.approx(0.05)


def test_seeds_needed_at_the_edges() -> None:
    assert stats.seeds_needed(0.0, (1.0, 1.0)) == math.inf
    assert stats.seeds_needed(1e-6, (1.0, 1.0)) == math.inf
    assert stats.seeds_needed(1.0, (0.0, 0.0)) == 2
    assert math.isnan(stats.seeds_needed(1.0, (math.nan, 1.0)))


def test_best_of_two_is_the_mean_over_all_pairs() -> None:
    values = np.random.default_rng(6).normal(size=9)
    expected = np.mean([max(pair) for pair in combinations(values, 2)])
    found = stats.best_of_two(values)
    assert found.value == pytest.approx(expected)
    assert found.low < found.value < found.high
    assert stats.best_of_two(numbers(3, 7)) == pytest.approx((7, math.nan, math.nan), nan_ok=True)
    assert math.isnan(stats.best_of_two(numbers(3)).value)


def test_best_of_two_normal_runs_gains_what_theory_says() -> None:
    """E max(X, Y) = m + s / sqrt(pi) for two independent normal runs."""
    values = np.random.default_rng(8).normal(100, 15, 20_000)
    assert stats.best_of_two(values[:2_000]).value - 100 == pytest.approx(
        15 / math.sqrt(math.pi), abs=1
    )


def test_jackknife_error_is_the_deviation_over_repetitions() -> None:
    rng = np.random.default_rng(9)
    found = [stats.best_of_two(rng.normal(size=12)) for _ in range(500)]
    errors = [(one.high - one.low) / 2 / scipy.t.ppf(0.975, 11) for one in found]
    assert np.mean(errors) == pytest.approx(np.std([one.value for one in found]), rel=0.1)


@pytest.mark.filterwarnings("error")
def test_iqm_of_runs_that_are_equal_but_one() -> None:
    """Of ten runs, nine at a task's largest return: BCa has no interval, the percentile has."""
    found = stats.iqm([numbers(*[1000.0] * 9, 900.0)])
    assert found.value == found.high == 1000
    assert 900 < found.low <= 1000

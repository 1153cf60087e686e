"""Statistics of runs that differ by seed only. Arrays hold one value per run unless stated.

What is computed follows Agarwal et al. 2021 (Deep RL at the edge of the statistical precipice) for
aggregates, and Colas et al. 2018 (How many random seeds?) for pairs and for power.
"""

import warnings
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy import stats as scipy_stats

Array = NDArray[np.float64]
scipy: Any = scipy_stats

CONFIDENCE = 0.95
FEWEST_SEEDS = 5  # below, a result is called indicative
BOOTSTRAP_SEEDS = 10  # below, a nominal 95% covers less: benchmarks/intervals.py
FEWEST_EVALUATIONS = 3  # behind a final return; a run of fewer is told apart
FEWEST_CHANCES = 3  # runs a side behind a probability: of one a side it is 0 or 1
RESAMPLES = 10_000
PROFILE_RESAMPLES = 2_000
POWER = 0.8
MOST_SEEDS = 1_000
SMOOTHING_ORDER = 3


class Interval(NamedTuple):
    """An estimate and its 95% interval, NaN where there are too few values for one."""

    value: float
    low: float = np.nan
    high: float = np.nan


# One run: evaluation steps (N,) and mean returns (N,) to one number.


def final(steps: Array, returns: Array, budget: float) -> float:
    """Mean of the evaluations in the last 10% of the budget, and of at least three.

    Of one or two it is the last: the mean would take in the policy when it had hardly learned.
    """
    if len(returns) < FEWEST_EVALUATIONS:
        return float(returns[-1])
    count = max(FEWEST_EVALUATIONS, int((steps > 0.9 * budget).sum()))
    return float(returns[-count:].mean())


def area(steps: Array, returns: Array) -> float:
    """Area under the curve by trapezoids over the steps it spans: the mean return of training."""
    if len(returns) == 1:
        return float(returns[0])
    return float(np.trapezoid(returns, steps) / (steps[-1] - steps[0]))


def reached(steps: Array, returns: Array, level: float) -> float:
    """Steps at the first evaluation that is at a level or above; infinity if there is none."""
    above = np.flatnonzero(returns >= level)
    return float(steps[above[0]]) if above.size else np.inf


def smooth(values: Array, window: int) -> Array:
    """Savitzky-Golay filter, for plots only: it looks ahead, and overshoots at jumps and ends."""
    from scipy.signal import savgol_filter

    odd = min(window, len(values)) - (min(window, len(values)) + 1) % 2
    if odd <= SMOOTHING_ORDER or not np.isfinite(values).all():  # the interval of one seed is NaN
        return values
    return cast("Array", savgol_filter(values, odd, SMOOTHING_ORDER))


# The runs of one group (n,).


def mean(values: Array) -> Interval:
    """Mean with Student's t interval, which keeps its coverage at few seeds."""
    value = float(values.mean())
    return Interval(value, *_t(value, deviation(values) / len(values) ** 0.5, len(values) - 1))


def band(curves: Array) -> tuple[Array, Array, Array]:
    """Mean curve of runs (n, N) and Student's t interval at each point; NaN for one run."""
    n = len(curves)
    middle = curves.mean(axis=0)
    if n < 2:
        return middle, np.full_like(middle, np.nan), np.full_like(middle, np.nan)
    half = curves.std(axis=0, ddof=1) / n**0.5 * scipy.t.ppf((1 + CONFIDENCE) / 2, n - 1)
    return middle, middle - half, middle + half


def deviation(values: Array) -> float:
    """Standard deviation over seeds, with n - 1; NaN for one seed."""
    return float(values.std(ddof=1)) if len(values) > 1 else np.nan


def best_of_two(values: Array) -> Interval:
    """Mean over all pairs of seeds of the better one, with a jackknife t interval over seeds.

    This is what picking the better of two independent runs afterwards gives; NaN for one seed.
    """
    n = len(values)
    if n < 2:
        return Interval(np.nan)
    value = _mean_larger(values)
    if n < 3:
        return Interval(value)
    without = np.array([_mean_larger(np.delete(values, seed)) for seed in range(n)])
    error = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    return Interval(value, *_t(value, error, n - 1))


def _mean_larger(values: Array) -> float:
    """By ranks: in increasing order, value i is the larger one of i pairs."""
    n = len(values)
    return float(np.sort(values) @ np.arange(n) / (n * (n - 1) / 2))


def _t(value: float, error: float, freedom: float) -> tuple[float, float]:
    if freedom < 1 or not np.isfinite(error):
        return np.nan, np.nan
    half = error * float(scipy.t.ppf((1 + CONFIDENCE) / 2, freedom))
    return value - half, value + half


# Several tasks, each (n of that task,): resampled task by task, which is what stratified means.


def iqm(tasks: Sequence[Array]) -> Interval:
    """Interquartile mean of all runs of all tasks: the mean of their middle half.

    From ten seeds on one task gets a BCa bootstrap interval, several a stratified percentile one
    as in Agarwal et al.: below, either would be far too narrow.
    """
    value = float(_iqm(*tasks))
    if min(len(task) for task in tasks) < BOOTSTRAP_SEEDS:
        return Interval(value)
    if all(np.ptp(task) == 0 for task in tasks):
        return Interval(value, value, value)
    low, high = _bootstrapped(tasks, "BCa" if len(tasks) == 1 else "percentile")
    if np.isnan(low):  # all runs but one are equal, and BCa divides 0 by 0
        low, high = _bootstrapped(tasks, "percentile")
    return Interval(value, low, high)


def _bootstrapped(tasks: Sequence[Array], method: str) -> list[float]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = scipy.bootstrap(
            tuple(tasks), _iqm, n_resamples=RESAMPLES, vectorized=True, method=method, rng=0
        )
    return [*map(float, found.confidence_interval)]


def _iqm(*tasks: Array, axis: int = -1) -> Any:
    return scipy.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis)


def improvement(pairs: Sequence[tuple[Array, Array]]) -> Interval:
    """Probability that a run of x beats one of y on a task, ties counting half, mean over tasks.

    With one task this is the Mann-Whitney U statistic over n m. NaN from fewer than three runs a
    side. The interval is a percentile bootstrap from ten runs a side on, over all tasks; where
    every pair has the same outcome, resampling says nothing.
    """
    sides = [side for pair in pairs for side in pair]
    if min(map(len, sides)) < FEWEST_CHANCES or not np.isfinite(np.concatenate(sides)).all():
        return Interval(np.nan)
    rng = np.random.default_rng(0)
    value, draws, alike = 0.0, np.zeros(RESAMPLES), True
    for x, y in pairs:
        difference = x[:, None] - y
        wins = (difference > 0) + 0.5 * (difference == 0)
        value += wins.mean() / len(pairs)
        alike = alike and np.ptp(wins) == 0
        drawn = (_weights(rng, len(x), RESAMPLES) @ wins) * _weights(rng, len(y), RESAMPLES)
        draws += drawn.sum(axis=1) / len(pairs)
    few = min(sum(map(len, side)) for side in zip(*pairs, strict=True)) < BOOTSTRAP_SEEDS
    return Interval(value) if few or alike else Interval(value, *_percentiles(draws))


def profile(tasks: Sequence[Array], levels: Array) -> tuple[Array, Array, Array]:
    """Performance profile: share of runs above each level (L,), mean over tasks, and its band."""
    rng = np.random.default_rng(0)
    value, draws = np.zeros(len(levels)), np.zeros((PROFILE_RESAMPLES, len(levels)))
    for task in tasks:
        above = (task[:, None] > levels).astype(float)
        value += above.mean(axis=0) / len(tasks)
        draws += _weights(rng, len(task), PROFILE_RESAMPLES) @ above / len(tasks)
    if min(len(task) for task in tasks) < BOOTSTRAP_SEEDS:
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    low, high = _percentiles(draws)
    return value, low, high


def _weights(rng: np.random.Generator, n: int, resamples: int) -> Array:
    """How much each of n runs weighs in each resample: (resamples, n)."""
    return rng.multinomial(n, np.full(n, 1 / n), size=resamples) / n


def _percentiles(draws: Array) -> Any:
    return np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)


# Two groups, (n,) and (m,).


def difference(x: Array, y: Array) -> Interval:
    """Mean of x minus mean of y with Welch's t interval."""
    value = float(x.mean() - y.mean())
    if min(len(x), len(y)) < 2:
        return Interval(value)
    if np.ptp(x) == 0 == np.ptp(y):
        return Interval(value, value, value)
    with warnings.catch_warnings():  # SciPy warns if all runs of one group are equal
        warnings.simplefilter("ignore", RuntimeWarning)
        found = scipy.ttest_ind(x, y, equal_var=False).confidence_interval(CONFIDENCE)
    return Interval(value, float(found.low), float(found.high))


def power(seeds: int, gap: float, deviations: tuple[float, float]) -> float:
    """Chance that a two-sided t test at 5% with this many seeds per side sees a gap of means."""
    pooled = np.sqrt(np.mean(np.square(deviations)))
    freedom, shift = 2 * seeds - 2, abs(gap) / pooled * (seeds / 2) ** 0.5
    bound = scipy.t.ppf((1 + CONFIDENCE) / 2, freedom)
    return float(scipy.nct.sf(bound, freedom, shift) + scipy.nct.cdf(-bound, freedom, shift))


def seeds_needed(gap: float, deviations: tuple[float, float]) -> float:
    """Seeds per side to see a gap with 80% power, if the standard deviations are right.

    Infinity if more than a thousand would be needed, NaN where a standard deviation is not known.
    """
    if not np.all(np.isfinite([gap, *deviations])):
        return np.nan
    if gap == 0:
        return np.inf
    if max(deviations) == 0:
        return 2
    tried = range(2, MOST_SEEDS + 1)
    place = bisect_left(tried, POWER, key=lambda seeds: power(seeds, gap, deviations))
    return tried[place] if place < len(tried) else np.inf

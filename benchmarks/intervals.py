"""How often the intervals of `compare` cover the truth, on normally distributed returns.

The nominal share is 95%. The rows of few seeds are why no bootstrap interval of a mean is printed
for them, and those of three tasks why P(better) of several tasks has one from ten runs a side on.
"""

import argparse
from collections.abc import Callable

import numpy as np
from scipy.stats import bootstrap, norm, trim_mean
from tabulate import tabulate

from pacesetter.study.compare import stats
from pacesetter.study.compare.stats import Array

SEEDS = (5, 10)
CHANCES = (0.5, 0.65, 0.8)  # that one run is better than one of the control
TASKS, RUNS = 3, 4


def bca(values: Array) -> tuple[float, float]:
    """The BCa interval of the interquartile mean, at however few runs."""
    found = bootstrap(
        (values,), lambda x, axis: trim_mean(x, 0.25, axis=axis), method="BCa", rng=0
    ).confidence_interval
    return float(found.low), float(found.high)


def student(values: Array) -> tuple[float, float]:
    """Student's t interval of the mean, as `compare` prints it."""
    return stats.mean(values)[1:]


def better(chance: float) -> Callable[[Array], tuple[float, float]]:
    """The interval of P(better) over all tasks, where that is truly `chance` on each."""
    shift = norm.ppf(chance) * 2**0.5

    def interval(values: Array) -> tuple[float, float]:
        x, y = values.reshape(2, TASKS, RUNS)
        return stats.improvement([*zip(x + shift, y, strict=True)])[1:]

    return interval


def covered(
    interval: Callable[[Array], tuple[float, float]], size: int, truth: float, draws: int
) -> str:
    """Share of the draws in which the interval of so many returns has the truth in it."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(draws):
        low, high = interval(rng.standard_normal(size))
        hits += bool(low <= truth <= high)
    return f"{hits / draws:.1%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=2_000, metavar="N")
    draws = parser.parse_args().draws
    rows = [
        (name, f"{seeds} seeds", covered(interval, seeds, 0.0, draws))
        for name, interval in (("mean, Student's t", student), ("IQM, BCa", bca))
        for seeds in SEEDS
    ]
    rows += [
        (
            f"P(better), truly {chance}",
            f"{TASKS} tasks, {RUNS} runs a side",
            covered(better(chance), 2 * TASKS * RUNS, chance, draws),
        )
        for chance in CHANCES
    ]
    print(tabulate(rows, ["interval", "of", "covers"], disable_numparse=True))


if __name__ == "__main__":
    main()

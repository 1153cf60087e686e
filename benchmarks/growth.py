"""How the cost of TD3 grows, as a table and a picture: each setting alone, against its floor.

The floor is the FLOP count of an update's matrix products over what this machine makes of a
256 x 256 x 256 product, measured in the same process, in turn with the updates.

    python benchmarks/growth.py -o docs/growth.png > growth.md
"""

import argparse
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import matplotlib
import numpy as np
from ceiling import TOGETHER, alone, flops, timed, whole
from tabulate import tabulate

from pacesetter import Trainer
from pacesetter.batch import Layout, Spec
from pacesetter.replay.buffer import Replay

matplotlib.use("Agg")
SQUARE = ((256, 256), (256, 256), (((1,), (0,)), ((), ())))
CHEETAH = Spec(17, 6)
LEAST = 30.0  # top over bottom of a plot


class Point(NamedTuple):
    """One measured size: seconds of `each` (update, draw, step) and their floor, if it has one."""

    what: str
    size: int
    each: str
    seconds: float
    floor: float | None


def peak(rng: np.random.Generator) -> Callable[[], float]:
    """Measures FLOP/s of square products of 256 each time it is called."""
    call = alone(SQUARE, rng)
    call()
    return lambda: flops(SQUARE) * TOGETHER / timed(call, 20)


def updates(what: str, sizes: list[int], task: Callable[[int], Any]) -> Iterator[Point]:
    """Seconds an update at each size, all sizes in turn."""
    best = peak(np.random.default_rng(0))
    cases = {size: task(size) for size in sizes}
    for call, *_ in cases.values():
        call()
    took: dict[int, list[float]] = {size: [] for size in sizes}
    floors: dict[int, list[float]] = {size: [] for size in sizes}
    for _ in range(5):
        for size, (call, counts, cycle) in cases.items():
            work = sum(flops(p) * n for p, n in counts.items()) / cycle
            repeats = max(1, int(0.2 * 1e11 / (work * cycle)))
            took[size].append(timed(call, repeats) / cycle)
            floors[size].append(work / best())
    for size in sizes:
        yield Point(what, size, "update", median(took[size]), median(floors[size]))


def members(size: int) -> Any:
    return whole("td3", CHEETAH, size)


def hidden(size: int) -> Any:
    return whole("td3", CHEETAH, 1, hidden=(size, size))


def batch(size: int) -> Any:
    return whole("td3", CHEETAH, 1, batch_size=size)


def observation(size: int) -> Any:
    return whole("td3", Spec(size, 6), 1)


def replay(sizes: list[int]) -> Iterator[Point]:
    """Seconds to draw a minibatch of 256 from a full ring."""
    rng = np.random.default_rng(0)
    for size in sizes:
        with TemporaryDirectory() as folder:
            ring = Replay(Path(folder) / "ring", Layout(CHEETAH), size, size)
            ring.rows[:] = 1.0
            ring.head = size
            took = median(timed(lambda r=ring: r.sample(rng, (256,)), 200) for _ in range(5))
            ring.close()
        yield Point("replay rows", size, "draw of 256", took, None)


def updates_per_step(sizes: list[int]) -> Iterator[Point]:
    """Seconds of a whole training step; its floor is that of its updates."""
    best = peak(np.random.default_rng(0))
    _, counts, cycle = whole("td3", CHEETAH, 1)
    work = sum(flops(p) * n for p, n in counts.items()) / cycle
    for size in sizes:
        with TemporaryDirectory() as folder:
            trainer = Trainer(
                "td3", "HalfCheetah-v5", runs=folder, warmup=50, eval_every=10**9,
                eval_episodes=1, updates_per_step=size,
            )  # fmt: skip
            for _ in range(100):
                trainer.loop.tick()
            took = median(timed(trainer.loop.tick, 100) for _ in range(3))
            floor = size * work / median(best() for _ in range(3))
            trainer.close()
        yield Point("updates a step", size, "step", took, floor)


def measured() -> Iterator[Point]:
    """Every table, small sizes first."""
    yield from updates("members", [1, 2, 5, 10, 20], members)
    yield from updates("hidden width", [64, 128, 256, 512, 1024], hidden)
    yield from updates("batch", [64, 256, 1024, 4096], batch)
    yield from updates("observation size", [11, 17, 105, 376], observation)
    yield from replay([10_000, 100_000, 1_000_000])
    yield from updates_per_step([1, 2, 4, 8])


def picture(points: list[Point], path: str) -> None:
    """One small plot a setting: measured, and the floor where there is one."""
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogLocator

    kinds = list(dict.fromkeys(point.what for point in points))
    figure, grid = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    for axes, kind in zip(grid.flat, kinds, strict=True):
        own = [point for point in points if point.what == kind]
        sizes = [point.size for point in own]
        axes.loglog(sizes, [p.seconds * 1e3 for p in own], "o-", color="#0072B2", label="measured")
        if own[0].floor is not None:
            floors = [(p.floor or 0) * 1e3 for p in own]
            axes.loglog(sizes, floors, "--", color="#D55E00", label="floor from FLOPs")
        axes.set(xlabel=kind, ylabel=f"ms a {own[0].each}".replace("a u", "an u"))
        axes.set_xticks(sizes, [f"{size:,}" for size in sizes], minor=False)
        axes.set_xticks([], minor=True)
        bottom, top = axes.get_ylim()
        wider = max(1.0, LEAST * (bottom / top)) ** 0.5  # what hardly grows should look flat
        axes.set_ylim(bottom / wider, top * wider)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
        axes.grid(alpha=0.3)
    grid.flat[0].legend(frameon=False)
    figure.savefig(path, dpi=110)


def row(point: Point) -> tuple[str, ...]:
    """A line of the table."""
    start = (point.what, f"{point.size:,}", point.each, f"{point.seconds * 1e3:.3f}")
    if point.floor is None:
        return (*start, "-", "-")
    return (*start, f"{point.floor * 1e3:.3f}", f"{point.floor / point.seconds:.2f}")


def main() -> None:
    """Print the table, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", default="growth.png")
    chosen = parser.parse_args()
    points = list(measured())
    print(f"jax {jax.__version__}, {len(os.sched_getaffinity(0))} cores\n")
    heads = ["setting", "size", "of each", "ms", "floor, ms", "floor / measured"]
    print(tabulate([row(point) for point in points], heads, "github", disable_numparse=True))
    picture(points, chosen.output)


if __name__ == "__main__":
    main()

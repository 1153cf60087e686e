"""The random streams of a run, all derived from one seed; none shifts another."""

from collections.abc import Mapping
from enum import IntEnum

import numpy as np

Range = tuple[float, float]  # lowest, highest


class Stream(IntEnum):
    """What a stream is for. New ones go at the end: the numbers decide every drawn bit."""

    TRAIN = 0
    SELECT = 1
    EVALUATE = 2
    REPORT = 3
    WARMUP = 4
    SAMPLE = 5
    RULE = 6
    ACT = 7
    MASK = 8
    VARY = 9  # from here on no episodes, whose seeds have room for eight streams
    TASK = 10


def generator(seed: int, stream: Stream, index: int = 0) -> np.random.Generator:
    """NumPy generator of one stream of one member."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream, index)))


def episode_seed(seed: int, stream: Stream, index: int, episode: int) -> int:
    """Seed of one episode's `reset`, of 32 bits, as older generators take no more.

    Its low bits are the stream, so streams never share a start. An episode seeded by its number
    can be started again at any time, which makes a resumed run exact.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(stream, index, episode))
    return int(sequence.generate_state(1)[0]) >> 3 << 3 | stream


def draw_task(
    seed: int, stream: Stream, index: int, episode: int, ranges: Mapping[str, Range]
) -> dict[str, float]:
    """One episode's keywords of the task, each uniform in its range (lowest, highest)."""
    key = (Stream.TASK, stream, index, episode)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    return {name: float(rng.uniform(low, high)) for name, (low, high) in sorted(ranges.items())}

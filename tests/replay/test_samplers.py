"""Every way of sampler rows against the formula it stands for, written out once more."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scripted_runs import IDLE, script, start
from short_runs import TINY, content, run_to_end

from pacesetter.batch import Layout, Spec, Transition
from pacesetter.replay.buffer import Replay, make_sampler
from pacesetter.replay.by_return import ByReturn
from pacesetter.replay.prioritized import MEASURES, ByError, SumTree
from pacesetter.replay.sampler import Sampler
from pacesetter.settings import OffPolicy
from pacesetter.training.trainer import Trainer

CORRIDOR = "probe_envs:Corridor-v0"
KINDS = ("prioritized", "lap", "return")


def per(
    size: int, exponent: float = 0.6, importance: float = 0.4, kind: str = "prioritized"
) -> Any:
    return ByError(size, exponent, importance, MEASURES[kind])


def grow(sampler: Any, count: int, member: int = 0) -> range:
    """Add rows and give the window."""
    for number in range(sampler.known, sampler.known + count):
        sampler.add(number, member, 0.0)
    return range(max(0, sampler.known + count - sampler.tree.size), sampler.known + count)


def tell(sampler: Any, window: range, errors: Any) -> None:
    """Draw once, so that all rows are known, then give each the error of its place in `errors`."""
    sampler.sample(np.random.default_rng(0), (1, 4), window, 0.0)
    sampler.feedback(np.array([window]), np.array([errors]))


def mass(sampler: Any, window: range) -> Any:
    """The share of each row of the window."""
    values = sampler.tree.values[np.array(window) % sampler.tree.size]
    return values / values.sum()


# Sums.


def test_blocks_find_what_a_running_sum_finds(rng: np.random.Generator) -> None:
    """Whole numbers, whose sums are exact: ten thousand changes, with searchsorted as the judge."""
    sums, plain = SumTree(500), np.zeros(500)
    for _ in range(400):
        places, values = rng.integers(500, size=25), rng.integers(5, size=25).astype(float)
        sums.put(places, values)
        for place, value in zip(places, values, strict=True):
            plain[place] = value
        total = plain.sum()
        wanted = rng.integers(int(total), size=(2, 10)) + 0.5
        found = np.cumsum(plain).searchsorted(wanted, side="right")
        np.testing.assert_array_equal(sums.find(wanted / total), found)
    np.testing.assert_array_equal(sums.values[:500], plain)
    again = SumTree(500)
    again.put(np.arange(500), plain)
    np.testing.assert_array_equal(again.sums, sums.sums)


def test_sums_do_not_depend_on_their_history(rng: np.random.Generator) -> None:
    """Bit for bit those of a fresh object, as a resumed run needs; also of one block."""
    for size in (7, 1000):
        sums = SumTree(size)
        for _ in range(200):
            sums.put(rng.integers(size, size=9), rng.random(9) ** 7 * 1e6)
        again = SumTree(size)
        again.put(np.arange(size), sums.values[:size])
        np.testing.assert_array_equal(again.sums, sums.sums)


def test_nothing_without_priority_is_found(rng: np.random.Generator) -> None:
    """Neither at the ends of [0, 1), nor where rounding carries past the last sum."""
    sums, filled = SumTree(1000), rng.choice(1000, 300, replace=False)
    sums.put(filled, rng.random(300) ** 9 + 1e-12)
    ends = np.cumsum(sums.values) / sums.values.sum()
    edges = np.concatenate([ends, np.nextafter(ends, 0), [0.0, np.nextafter(1.0, 0)]])
    found = sums.find(np.minimum(edges, np.nextafter(1.0, 0)))
    assert set(found) <= set(filled)


# By error.


def test_golden_shares_and_weights(rng: np.random.Generator) -> None:
    """Priorities 1 to 4, exponent .6, importance .4."""
    sampler = per(4)
    window = grow(sampler, 4)
    tell(sampler, window, np.array([1, 2, 3, 4]) - 1e-6)
    share = [0.148230, 0.224674, 0.286555, 0.340542]
    np.testing.assert_allclose(mass(sampler, window), share, atol=1e-6)
    numbers, weight = sampler.sample(rng, (3, 100), window, 0.0)
    expected = np.array([1, 0.846745, 0.768229, 0.716978])
    np.testing.assert_allclose(weight, expected[numbers], atol=1e-6)
    numbers, _ = sampler.sample(rng, (100_000, 1), window, 0.0)
    expected = np.array(share) / sum(share) * 1e5
    assert stats.chisquare(np.bincount(numbers.ravel()), expected).pvalue > 1e-3


def test_strata_share_a_minibatch_out(rng: np.random.Generator) -> None:
    """Of 1,000 draws each row has its share to within one on either side."""
    sampler = per(4)
    window = grow(sampler, 4)
    tell(sampler, window, [1, 2, 3, 4])
    numbers, _ = sampler.sample(rng, (1, 1000), window, 0.0)
    counts = np.bincount(numbers.ravel(), minlength=4)
    assert np.abs(counts - 1000 * mass(sampler, window)).max() < 2


def test_weights_are_whole_at_the_end(rng: np.random.Generator) -> None:
    """With beta 1, share times weight is the same for all rows, so any weighted mean is unbiased;
    halfway beta is halfway.
    """
    sampler = per(64)
    window = grow(sampler, 64)
    tell(sampler, window, rng.random(64) * 9)
    share = mass(sampler, window)
    numbers, weight = sampler.sample(rng, (2, 500), window, 1.0)
    assert weight.dtype == np.float32
    for row, product in zip(numbers, weight * share[numbers], strict=True):
        np.testing.assert_allclose(product, share[row].min(), rtol=1e-6)
    numbers, weight = sampler.sample(rng, (1, 500), window, 0.5)
    np.testing.assert_allclose(weight, (share[numbers].min() / share[numbers]) ** 0.7, rtol=1e-6)


def test_lap_has_a_floor_and_no_weights(rng: np.random.Generator) -> None:
    """Priority max(error, 1) ** .4."""
    sampler = make_sampler(OffPolicy(replay="lap"), 4)
    assert isinstance(sampler, ByError)
    window = grow(sampler, 4)
    tell(sampler, window, [0.0, 0.5, 1.0, 32.0])
    np.testing.assert_allclose(sampler.tree.values[:4], [1, 1, 1, 4])
    assert sampler.sample(rng, (2, 8), window, 0.5).weight is None


def test_the_last_error_of_a_row_counts() -> None:
    """Within a minibatch, over the minibatches of a cycle, and over the members' cycles."""
    sampler = per(8, exponent=1)
    tell(sampler, grow(sampler, 8), [1.0] * 8)
    sampler.feedback(np.array([[3, 3, 5], [5, 6, 7]]), np.array([[1, 2, 3], [4, 5, 6]], np.float32))
    sampler.feedback(np.array([[7]]), np.array([[9]], np.float32))
    expected = np.array([1, 1, 1, 2, 1, 4, 5, 9]) + 1e-6
    np.testing.assert_allclose(sampler.tree.values[:8], expected, rtol=1e-12)


def test_new_rows_take_the_largest_priority(rng: np.random.Generator) -> None:
    """At once, and the largest is measured anew after 250 updates."""
    sampler = per(8, exponent=1)
    window = grow(sampler, 4)
    tell(sampler, window, [1e-3, 1e-3, 8.0, 1e-3])
    assert sampler.largest == 8 + 1e-6
    window = grow(sampler, 1)
    numbers, _ = sampler.sample(rng, (1, 100), window, 0.0)
    assert 40 < (numbers == 4).sum() < 60
    sampler.feedback(np.array([[2], [4]]), np.array([[0.5], [0.25]], np.float32))
    assert sampler.largest == 8 + 1e-6
    one = np.array([[0]]), np.array([[0.125]], np.float32)
    while sampler.updates < 250:
        sampler.feedback(*one)
    assert sampler.largest == 0.5 + 1e-6


def test_priorities_equal_a_plain_table_around_the_ring(rng: np.random.Generator) -> None:
    """Rows come, leave and are drawn; a dict of row numbers is the judge."""
    sampler: Any = per(50)
    table: dict[int, float] = {}
    for _ in range(300):
        head = sampler.known
        fresh = int(rng.integers(1, 9))
        for number in range(head, head + fresh):
            table[number] = sampler.largest
        window = grow(sampler, fresh)
        table = {n: value for n, value in table.items() if n in window}
        numbers, _ = sampler.sample(rng, (2, 16), window, 0.0)
        assert set(numbers.ravel()) <= set(window)
        error = rng.random((2, 16)).astype(np.float32) * 3
        sampler.feedback(numbers, error)
        for number, value in zip(numbers.ravel(), error.ravel(), strict=True):
            table[int(number)] = (float(value) + 1e-6) ** 0.6
        expected = np.array([table[n] for n in window])
        found = sampler.tree.values[np.array(window) % 50]
        np.testing.assert_allclose(found, expected, rtol=1e-14)
        np.testing.assert_allclose(sampler.tree.sums.sum(), expected.sum(), rtol=1e-12)


# By return.


def episodes(sampler: ByReturn, returns: Any, length: int = 3, member: int = 0) -> range:
    """Play episodes whose steps each pay their share; the window."""
    for total in returns:
        for step in range(length):
            sampler.add(sampler.head, member, total * step / length)
        sampler.end(member, total)
    return range(max(0, sampler.head - sampler.size), sampler.head)


def shares(sampler: ByReturn, window: range) -> Any:
    """Priority of each row, without the normaliser."""
    return sampler.priority(np.array(window)) * 1.05**sampler.exponent


def test_rows_rank_by_their_episodes_return() -> None:
    """(0.05 + (rank + 1/2) / n) ** .6, whatever the returns' scale and sign; ties share a rank."""
    expected = (0.05 + (np.array([2, 0, 1, 3]) + 0.5) / 4) ** 0.6
    for scale, shift in [(1, 0), (7, -1000), (0.01, 3)]:
        sampler = ByReturn(100, 0.6, 0.0, to_go=False)
        window = episodes(sampler, [scale * x + shift for x in (5, -7, 0, 900)])
        np.testing.assert_allclose(shares(sampler, window), expected.repeat(3), rtol=1e-12)
    sampler = ByReturn(100, 1.0, 0.0, to_go=False)
    window = episodes(sampler, [4, 4, 1])
    ranks = np.array([2, 2, 0.5]) / 3
    np.testing.assert_allclose(shares(sampler, window), (0.05 + ranks).repeat(3), rtol=1e-12)


def test_running_episodes_are_in_the_middle_and_members_apart() -> None:
    """Two members' rows in turn; whose episode ended takes its rank, the other's waits."""
    sampler = ByReturn(100, 1.0, 0.0, to_go=False)
    episodes(sampler, [10])
    for _ in range(3):
        sampler.add(sampler.head, 0, 0.0)
        sampler.add(sampler.head, 1, 0.0)
    sampler.end(1, 20.0)
    window = range(3, 9)
    np.testing.assert_allclose(shares(sampler, window), np.tile([0.55, 0.8], 3))
    np.testing.assert_allclose(shares(sampler, range(3)), 0.3)
    sampler.end(0, None)  # broke off: it keeps the middle, and the next episode starts afresh
    sampler.add(sampler.head, 0, 0.0)
    sampler.end(0, 30.0)
    ranks = [1 / 6] * 3 + [1 / 2] * 6 + [5 / 6]
    np.testing.assert_allclose(shares(sampler, range(10)) - 0.05, ranks)


def test_return_to_go_ranks_each_row() -> None:
    """Rewards 1, 2, 3 and 5, -5, 4: to go 6, 5, 3 and 4, -1, 4."""
    sampler = ByReturn(100, 1.0, 0.0, to_go=True)
    for rewards in ([1, 2, 3], [5, -5, 4]):
        for step, earned in enumerate(np.cumsum([0, *rewards[:-1]])):
            sampler.add(sampler.head, 0, float(earned))
            assert step < 3
        sampler.end(0, float(sum(rewards)))
    ranks = (stats.rankdata([6, 5, 3, 4, -1, 4]) - 0.5) / 6
    np.testing.assert_allclose(shares(sampler, range(6)), 0.05 + ranks)


def test_return_to_go_among_many_rows(rng: np.random.Generator) -> None:
    """Beyond 4,096 rows they are ranked among a part of them, to within a few hundredths."""
    sampler = ByReturn(20_000, 1.0, 0.0, to_go=True)
    window = episodes(sampler, rng.normal(size=200) * 50, length=130)
    assert len(sampler.ranking) <= 4096
    scores = sampler.scores[np.array(window) % 20_000]
    exact = (stats.rankdata(scores) - 0.5) / len(scores)
    np.testing.assert_allclose(shares(sampler, window), 0.05 + exact, atol=0.03)


def test_what_left_the_window_has_no_rank(rng: np.random.Generator) -> None:
    """Seven rows are left: of episode 30 one, of 20 and 10 all; 40 counts no more."""
    sampler = ByReturn(7, 1.0, 0.0, to_go=False)
    window = episodes(sampler, [40, 30, 20, 10])
    assert window == range(5, 12)
    np.testing.assert_allclose(shares(sampler, window) - 0.05, np.array([5, 3, 3, 3, 1, 1, 1]) / 6)
    numbers, _ = sampler.sample(rng, (100, 100), window, 0.0)
    assert set(numbers.ravel()) == set(window)


@pytest.mark.parametrize("to_go", [False, True])
def test_rows_are_drawn_by_rank(to_go: bool, rng: np.random.Generator) -> None:
    """Chi-square of 100,000 draws, after the ring has gone round; weights undo the shares."""
    sampler = ByReturn(40, 2.0, 0.5, to_go)
    window = episodes(sampler, rng.normal(size=30), length=5)
    sampler.add(sampler.head, 0, 0.0)
    window = range(window.start + 1, window.stop + 1)
    share = shares(sampler, window)
    numbers, weight = sampler.sample(rng, (2, 50_000), window, 1.0)
    counts = np.bincount(numbers.ravel() - window.start)
    assert stats.chisquare(counts, share / share.sum() * 1e5).pvalue > 1e-3
    product = weight * share[numbers - window.start]
    np.testing.assert_allclose(product, share.min(), rtol=1e-6)


# All kinds.


@pytest.mark.parametrize("kind", KINDS)
def test_exponent_zero_is_uniform(kind: str, rng: np.random.Generator) -> None:
    """Every row has the same share and weight 1; by return even the first draw is the same."""
    sampler: Any = make_sampler(OffPolicy(replay=kind, replay_exponent=0), 60)
    window = range(20, 80)
    for number in range(80):
        sampler.add(number, 0, 0.0)
        if number % 7 == 6:
            sampler.end(0, float(number))
    sampler.sample(rng, (2, 5), window, 0.0)
    sampler.feedback(np.array([window]), rng.random((1, 60)).astype(np.float32))
    numbers, weight = sampler.sample(rng, (60_000, 1), window, 0.5)
    assert stats.chisquare(np.bincount(numbers.ravel() - 20)).pvalue > 1e-3
    assert weight is None or np.all(weight == 1)
    if kind == "return":
        first, again = np.random.default_rng(3), np.random.default_rng(3)
        uniform = Sampler().sample(first, (2, 50), window, 0.0).numbers
        np.testing.assert_array_equal(sampler.sample(again, (2, 50), window, 0.0).numbers, uniform)
    else:
        assert np.all(mass(sampler, window) == 1 / 60)


@pytest.mark.parametrize("kind", [*KINDS, "to-go"])
@pytest.mark.parametrize("rows", [30, 130, 197])
def test_replay_draws_only_its_window_and_goes_on_after_a_stop(
    kind: str, rows: int, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Rows are those of their numbers; a copy from the arrays draws the same, as it grows too."""
    to_go = kind == "to-go"
    hyper = OffPolicy(replay="return" if to_go else kind, replay_to_go=to_go)  # type: ignore[arg-type]
    mask = np.zeros(0, np.float32)
    replays = [
        Replay(tmp_path / f"{i}.bin", Layout(Spec(1, 1)), 50, 10_000, make_sampler(hyper, 50))
        for i in (0, 1)
    ]

    def fill(replay: Replay, count: int) -> None:
        for _ in range(count):
            x = np.full(1, replay.head, np.float32)
            k = replay.head % 3 // 2
            earned = float(replay.head % 5)
            replay.add(Transition(x, x, 1.0, x, 0.9, False, mask, earned), k)
            if replay.head % 11 == 0:
                replay.sampler.end(k, float(replay.head % 13))

    def cycle(replay: Replay, stream: np.random.Generator) -> Any:
        sample = replay.sample(stream, (2, 32), 0.25)
        assert sample.numbers.min() >= replay.head - len(replay)
        np.testing.assert_array_equal(sample.rows[..., 0], sample.numbers)
        replay.feedback(sample.numbers, np.sin(sample.rows[..., 0]) ** 2)
        return sample

    first, second = replays
    for _ in range(rows):
        fill(first, 1)
        cycle(first, rng)
    fill(first, 3)
    fill(second, first.head)  # the rows alone are in the file
    table, arrays = second.commit(), {key: x.copy() for key, x in first.arrays().items()}
    second.sampler = make_sampler(hyper, 50)
    second.restore(table, arrays)
    one, other = np.random.default_rng(5), np.random.default_rng(5)
    for _ in range(70):
        a, b = cycle(first, one), cycle(second, other)
        np.testing.assert_array_equal(a.numbers, b.numbers)
        if a.weight is not None:
            np.testing.assert_array_equal(a.weight, b.weight)
        fill(first, 2)
        fill(second, 2)


# In a run.


def test_cycles_of_all_members_are_drawn_before_any_error_returns(runs: Path) -> None:
    """One replay for both: sample, sample, feedback, feedback."""
    settings: dict[str, Any] = {**TINY, "warmup": 20, "steps": 60, "replay": "prioritized"}
    trainer = Trainer("multi-td3", CORRIDOR, runs=runs, env_kwargs={"cut_at": 10}, **settings)
    sampler, calls = trainer.loop.replays[0].sampler, list[str]()
    sample, feedback = sampler.sample, sampler.feedback

    def watched_sample(*words: Any) -> Any:
        calls.append("sample")
        return sample(*words)

    def watched_feedback(*words: Any) -> None:
        calls.append("feedback")
        feedback(*words)

    sampler.sample, sampler.feedback = watched_sample, watched_feedback  # type: ignore[method-assign]
    run_to_end(trainer)
    assert calls == ["sample", "sample", "feedback", "feedback"] * (len(calls) // 4)
    assert len(calls) == 40


def scores(trainer: Trainer) -> list[float | None]:
    """What each row of a run of 50 steps is ranked by, None where it is not known."""
    while trainer.progress.step < 50:
        trainer.loop.tick()
    sampler: Any = trainer.loop.replays[0].sampler
    found = [None if np.isnan(score) else float(score) for score in sampler.scores[:50]]
    trainer.close()
    return found


def test_rows_of_a_run_have_the_return_of_their_episode(runs: Path) -> None:
    """Members 0 and 1 in turn, two episodes each, and five steps of a third."""
    trainer = start(runs, ([3, 4], [5, 6]), replay="return", steps=50, **IDLE)
    assert scores(trainer) == [3, 5] * 10 + [4, 6] * 10 + [None] * 10


def test_rows_of_a_run_have_their_return_to_go(runs: Path) -> None:
    """A step pays 1, so that of an episode of 10 steps 10, 9, ... are to come; of one of 6, 6."""
    settings: dict[str, Any] = {**TINY, "warmup": 0, "steps": 50, "wait": False, **IDLE}
    trainer = Trainer("multi-td3", CORRIDOR, runs=runs, replay="return", replay_to_go=True,
                      env_kwargs={"cut_at": 10}, **settings)  # fmt: skip
    script(trainer.loop.explorers[1].env, cut_at=6)
    first = [10 - n % 10 if n < 20 else None for n in range(25)]
    second = [6 - n % 6 if n < 24 else None for n in range(25)]
    assert scores(trainer) == [score for pair in zip(first, second, strict=True) for score in pair]


def watch(trainer: Trainer) -> list[float]:
    """The share of the horizon at each sample of a run."""
    seen: list[float] = []
    replay = trainer.loop.replays[0]
    sample = replay.sample

    def watched(rng: Any, shape: Any, done: float) -> Any:
        seen.append(done)
        return sample(rng, shape, done)

    replay.sample = watched  # type: ignore[method-assign]
    return seen


def test_horizon_is_set_at_the_start(runs: Path) -> None:
    """The budget of the first start, whatever a resume allows; and beta follows it."""
    settings: dict[str, Any] = {**TINY, "steps": 200, "replay": "prioritized"}
    trainer = Trainer("td3", CORRIDOR, runs=runs, env_kwargs={"cut_at": 10}, **settings)
    seen = watch(trainer)
    run_to_end(trainer)
    assert seen == [step / 200 for step in range(102, 201, 2)]  # two updates a call
    trainer = Trainer.resume(trainer.directory.path, steps=400)
    assert trainer.directory.settings()["replay_horizon"] == 200
    seen = watch(trainer)
    run_to_end(trainer)
    assert len(seen) == 100
    assert set(seen) == {1.0}
    values = content(trainer.directory)["arrays"]["replay.0.values"]
    assert values.shape == (400,)
    assert len(np.unique(values)) > 10


def test_equal_returns_that_leave_together_all_leave_the_ranking() -> None:
    """Ten short episodes of return 0 are pushed out by one long one of return 1, again and again;
    a checkpoint in which some of them were left heals.
    """
    sampler = ByReturn(20, 0.6, 0.0, to_go=False)
    for _ in range(5):
        episodes(sampler, [0.0] * 10, length=1)
        window = episodes(sampler, [1.0], length=20)
    assert sampler.ranking.tolist() == [total for total, _ in sampler.ended] == [1.0]
    np.testing.assert_allclose(shares(sampler, window), 0.55**0.6)
    stale = sampler.arrays(window) | {"ranking": np.array([0.0, 0.0, 1.0])}
    sampler.restore(stale, window)
    assert sampler.ranking.tolist() == [1.0]

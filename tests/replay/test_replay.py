"""The ring against a plain list, and its file against crashes, damage and growth."""

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pacesetter.batch import Layout, Spec, Transition
from pacesetter.errors import UsageError
from pacesetter.replay import buffer as module
from pacesetter.replay.buffer import Replay

LAYOUT = Layout(Spec(observation_size=2, action_size=1), masks=2)
CAPACITY = 50
SHIPPED = (module.SLACK, module.UNCOMMITTED, module.MAX_ROWS_PER_TICK, module.BLOCK)


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 8 rows, and 20 + 3 between checkpoints, so that few rows go all the way round."""
    monkeypatch.setattr(module, "BLOCK", 8)
    monkeypatch.setattr(module, "UNCOMMITTED", 20)
    monkeypatch.setattr(module, "MAX_ROWS_PER_TICK", 3)
    monkeypatch.setattr(module, "SLACK", 2 * (20 + 3) + 8)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "replay.bin"


def ring(file: Path, capacity: int = CAPACITY, budget: int = 10_000) -> Replay:
    return Replay(file, LAYOUT, capacity, budget)


def row(number: int) -> list[float]:
    """Transition `number`, all of whose parts can be told apart."""
    step = [number, number + 0.25, -number, number / 2, number + 1, number + 1.25]
    return [*step, 0.5, number % 2, number % 3, number % 5]


def fill(replay: Replay, count: int) -> None:
    for number in range(replay.head, replay.head + count):
        o, p, action, reward, q, r, discount, last, *mask = row(number)
        replay.add(
            Transition(
                observation=np.array([o, p], np.float32),
                action=np.array([action], np.float32),
                reward=reward,
                next_observation=np.array([q, r], np.float32),
                discount=discount,
                last=bool(last),
                mask=np.array(mask, np.float32),
            )
        )


class Everything:
    """A generator that draws each index of the window once, in order."""

    def integers(self, high: int, size: tuple[int, ...]) -> Any:
        return np.arange(high).reshape(size)


def window(replay: Replay) -> Any:
    """All rows that sampling can reach, oldest first."""
    everything: Any = Everything()
    return replay.sample(everything, (len(replay),)).rows


def test_ring_equals_a_bounded_list(file: Path) -> None:
    """After every row of several times round, the window is the last `capacity` rows in order."""
    replay, expected = ring(file), deque[list[float]](maxlen=CAPACITY)
    for number in range(5 * (CAPACITY + module.SLACK)):
        fill(replay, 1)
        expected.append(row(number))
        assert len(replay) == len(expected)
        np.testing.assert_array_equal(window(replay), np.array(expected, np.float32))


def test_parts_of_a_row_come_back_apart(file: Path) -> None:
    """What `add` was given is what a batch holds, each part under its name."""
    replay = ring(file)
    fill(replay, 4)
    batch = LAYOUT.unpack(window(replay))
    numbers = np.arange(4.0)
    np.testing.assert_array_equal(batch.observation, np.stack([numbers, numbers + 0.25], 1))
    np.testing.assert_array_equal(batch.action, -numbers[:, None])
    np.testing.assert_array_equal(batch.reward, numbers / 2)
    np.testing.assert_array_equal(
        batch.next_observation, np.stack([numbers + 1, numbers + 1.25], 1)
    )
    np.testing.assert_array_equal(batch.discount, np.full(4, 0.5))
    np.testing.assert_array_equal(batch.last, numbers % 2)
    assert batch.weight is None
    np.testing.assert_array_equal(batch.mask, np.stack([numbers % 3, numbers % 5], 1))


@pytest.mark.parametrize("rows", [30, CAPACITY, 130, 197])
def test_sampling_is_uniform_over_the_window(
    file: Path, rows: int, rng: np.random.Generator
) -> None:
    """Before and after wrapping: no other row is drawn, and chi-square of 50,000 draws agrees."""
    replay = ring(file)
    fill(replay, rows)
    size = min(rows, CAPACITY)
    sample = replay.sample(rng, (2, 25_000))
    assert sample.rows.shape == (2, 25_000, LAYOUT.width)
    np.testing.assert_array_equal(sample.rows, replay.rows[sample.numbers % replay.slots])
    counts = np.bincount(sample.rows[..., 0].astype(int).ravel(), minlength=rows)
    assert counts[: rows - size].sum() == 0
    assert stats.chisquare(counts[rows - size :]).pvalue > 1e-3


@settings(max_examples=30, deadline=None)
@given(
    capacity=st.integers(1, 70),
    first=st.integers(0, 300),
    between=st.integers(0, 23),
    after=st.integers(0, 23),
    older=st.booleans(),
)
def test_both_checkpoints_survive_what_comes_after(
    tmp_path_factory: pytest.TempPathFactory,
    capacity: int,
    first: int,
    between: int,
    after: int,
    older: bool,
) -> None:
    """Up to 20 + 3 rows after a checkpoint damage neither it nor the one before it, anywhere."""
    file = tmp_path_factory.mktemp("ring") / "replay.bin"
    replay = ring(file, capacity)
    fill(replay, first)
    kept = [(replay.commit(), window(replay))]
    fill(replay, between)
    kept.append((replay.commit(), window(replay)))
    fill(replay, after)
    replay.close()
    table, expected = kept[0 if older else 1]
    again = ring(file, capacity)
    again.restore(table)
    np.testing.assert_array_equal(window(again), expected)
    assert again.head == table["head"]


@pytest.mark.parametrize("phase", range(8))
def test_restored_ring_goes_on_as_the_first(file: Path, tmp_path: Path, phase: int) -> None:
    """Rows and hashes of later checkpoints are those of a ring that was never closed."""
    stopped, whole = ring(file), ring(tmp_path / "whole.bin")
    for replay in (stopped, whole):
        fill(replay, 120 + phase)
    table = stopped.commit()
    assert table == whole.commit()
    fill(stopped, 13)
    stopped.close()
    resumed = ring(file)
    resumed.restore(table)
    for replay in (resumed, whole):
        fill(replay, 17)
    np.testing.assert_array_equal(window(resumed), window(whole))
    assert resumed.commit() == whole.commit()


def test_commit_falls_due_before_the_slack_is_used_up(file: Path) -> None:
    """After 20 rows, not before, and a commit settles it."""
    replay = ring(file)
    fill(replay, 19)
    assert not replay.must_commit
    fill(replay, 1)
    assert replay.must_commit
    replay.commit()
    assert not replay.must_commit


def test_shipped_slack_covers_two_checkpoints() -> None:
    """Each may come a row of every member late; the oldest block is kept whole."""
    slack, uncommitted, members, block = SHIPPED
    assert slack == 2 * (uncommitted + members) + block


def test_rows_beyond_the_slack_are_noticed(file: Path) -> None:
    """A window that was written over is refused, never taken for the old one."""
    replay = ring(file)
    fill(replay, 100)
    table = replay.commit()
    fill(replay, module.SLACK + module.BLOCK + 1)
    replay.close()
    with pytest.raises(UsageError, match=r"replay\.bin: damaged"):
        ring(file).restore(table)


def flip(file: Path, number: int) -> None:
    """Change one bit of the first byte of row `number` in the file."""
    slot = number % (CAPACITY + module.SLACK)
    data = bytearray(file.read_bytes())
    data[slot * LAYOUT.width * 4] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize("number", [75, 80, 99, 119, 120, 124])
def test_one_flipped_bit_of_the_window_is_refused(file: Path, number: int) -> None:
    """In the oldest row, in whole blocks and in the newest rows; the file is named."""
    replay = ring(file)
    fill(replay, 125)
    table = replay.commit()
    replay.close()
    ring(file).restore(table)
    flip(file, number)
    with pytest.raises(UsageError, match=f"{file}: damaged"):
        ring(file).restore(table)


@pytest.mark.parametrize("number", [71, 125, 126])
def test_a_bit_outside_the_window_is_nobodys_loss(file: Path, number: int) -> None:
    """Rows that left the window, or were not committed, may hold anything."""
    replay = ring(file)
    fill(replay, 127)
    replay.head = 125
    table = replay.commit()
    expected = window(replay).copy()
    replay.close()
    flip(file, number)
    again = ring(file)
    again.restore(table)
    np.testing.assert_array_equal(window(again), expected)


def test_file_is_no_longer_than_the_budget_and_grows_with_it(file: Path) -> None:
    """A short run reserves only its own rows; a larger budget adds room and keeps the rows."""
    size = LAYOUT.width * 4
    short = ring(file, budget=30)
    assert file.stat().st_size == 30 * size
    fill(short, 30)
    table, expected = short.commit(), window(short).copy()
    short.close()
    longer = ring(file, budget=10_000)
    assert file.stat().st_size == (CAPACITY + module.SLACK) * size
    longer.restore(table)
    np.testing.assert_array_equal(window(longer), expected)
    fill(longer, 200)
    assert len(longer) == CAPACITY
    np.testing.assert_array_equal(window(longer)[:, 0], np.arange(180, 230))


def test_a_smaller_budget_never_cuts_the_file(file: Path) -> None:
    """Rows that a checkpoint needs stay where they are."""
    first = ring(file)
    fill(first, 120)
    table, expected = first.commit(), window(first).copy()
    first.close()
    again = ring(file, budget=5)
    again.restore(table)
    np.testing.assert_array_equal(window(again), expected)

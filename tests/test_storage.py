"""What is written is read back, byte for byte, and a failed write leaves what was there."""

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pacesetter import files, storage
from pacesetter.errors import UsageError
from pacesetter.storage import Content

BASE = np.arange(24, dtype=np.float32).reshape(4, 6)
# safetensors alone writes wrong bytes for most of these, and says nothing.
LAYOUTS = {
    "plain": BASE,
    "transposed": BASE.T,
    "columns": BASE[:, ::2],
    "rows": BASE[1:3],
    "backwards": BASE[::-1, ::-1],
    "fortran": np.asfortranarray(BASE),
    "broadcast": np.broadcast_to(BASE[0], (3, 6)),
    "swapped axes": BASE.reshape(2, 3, 4).swapaxes(0, 2),
    "one number": np.float32(3),
    "empty": np.zeros((0, 5), np.float32),
    "flags": BASE.T > 5,
    "counts": BASE.astype(np.int32).T,
    "doubles": BASE.astype(np.float64)[:, 1],
    "read-only": np.frombuffer(bytes(48), np.float32),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_layout_is_read_back(layout: str, tmp_path: Path) -> None:
    array = np.asarray(LAYOUTS[layout])
    file = tmp_path / "file"
    storage.write(file, "thing", Content({"a": array, "b": BASE}, {}))
    found = storage.read(file, "thing").arrays
    assert found["a"].dtype == array.dtype
    np.testing.assert_array_equal(found["a"], array, strict=True)
    np.testing.assert_array_equal(found["b"], BASE)


def test_equal_files_have_equal_bytes(tmp_path: Path) -> None:
    """Also under names and words that are not ASCII; safetensors alone shuffles its header."""
    content = Content({"gewähr": BASE, "a": BASE[0]}, {"who": "Žák", "b": [1]})
    found: set[bytes] = set()
    for _ in range(8):
        storage.write(tmp_path / "file", "thing", content)
        found.add((tmp_path / "file").read_bytes())
    assert len(found) == 1
    again = storage.read(tmp_path / "file", "thing")
    assert again.table == content.table
    np.testing.assert_array_equal(again.arrays["gewähr"], BASE)


def test_random_layouts_are_read_back(tmp_path: Path, rng: np.random.Generator) -> None:
    """Any permutation of axes with any steps along them."""
    arrays = {}
    for n in range(60):
        array = rng.normal(size=rng.integers(1, 6, size=rng.integers(1, 5))).astype(np.float32)
        steps = rng.choice([-2, -1, 1, 2], size=array.ndim)
        arrays[str(n)] = array.transpose(rng.permutation(array.ndim))[
            tuple(slice(None, None, step) for step in steps)
        ]
    storage.write(tmp_path / "file", "thing", Content(arrays, {}))
    found = storage.read(tmp_path / "file", "thing").arrays
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array, strict=True)


def test_table_is_read_back(tmp_path: Path) -> None:
    table = {"text": "ä\n\0", "huge": 2**200, "part": 0.1, "list": [1, None, True], "deep": {"": 1}}
    storage.write(tmp_path / "file", "thing", Content({}, table))
    assert storage.read(tmp_path / "file", "thing").table == table


def test_kind_is_checked(tmp_path: Path) -> None:
    storage.write(tmp_path / "file", "thing", Content({}, {}))
    with pytest.raises(UsageError, match="not a pacesetter other"):
        storage.read(tmp_path / "file", "other")


def test_replaced_file_is_kept(tmp_path: Path) -> None:
    """`keep` always holds the write before the last."""
    file, keep = tmp_path / "file", tmp_path / "before"
    for n in range(4):
        storage.write(file, "thing", Content({}, {"n": n}), keep)
        assert storage.read(file, "thing").table == {"n": n}
        assert not keep.exists() if n == 0 else storage.read(keep, "thing").table == {"n": n - 1}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["before", "file"]


STEPS = ("fsync", "link", "unlink", "replace")


@pytest.mark.parametrize("step", STEPS)
def test_failure_at_any_step_leaves_a_whole_file(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk, or when killed there: the old file or the new, never a part or none."""
    file, keep = tmp_path / "file", tmp_path / "before"
    for n in range(2):
        storage.write(file, "thing", Content({"a": BASE}, {"n": n}), keep)

    def fail(*arguments: Any, **options: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os if step in ("fsync", "link") else Path, step, fail)
        with pytest.raises(OSError, match="No space"):
            storage.write(file, "thing", Content({"a": BASE}, {"n": 2}), keep)
    assert storage.read(file, "thing").table == {"n": 1}
    storage.write(file, "thing", Content({"a": BASE}, {"n": 3}), keep)
    assert storage.read(file, "thing").table == {"n": 3}
    assert storage.read(keep, "thing").table == {"n": 1}


@pytest.mark.parametrize("answer", [errno.EPERM, errno.ENOTSUP, errno.ENOSYS])
def test_without_second_names_two_writes_are_kept_too(
    answer: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on exFAT and some network file systems."""

    def no_links(*arguments: Any, **options: Any) -> None:
        raise OSError(answer, os.strerror(answer))

    monkeypatch.setattr(os, "link", no_links)
    file, keep = tmp_path / "file", tmp_path / "before"
    for n in range(3):
        storage.write(file, "thing", Content({}, {"n": n}), keep)
    assert storage.read(file, "thing").table == {"n": 2}
    assert storage.read(keep, "thing").table == {"n": 1}
    files.link(keep, file)
    assert storage.read(file, "thing").table == {"n": 1}


def test_a_new_folder_has_its_name_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    assert files.make_folder(tmp_path / "new")
    assert synced == [tmp_path.stat().st_ino]
    assert not files.make_folder(tmp_path / "new")
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        files.make_folder(tmp_path / "file")


@pytest.mark.parametrize(("answer", "whole"), [(errno.EINVAL, True), (errno.EIO, False)])
def test_a_folder_that_cannot_be_synced(
    answer: int, whole: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """EINVAL is what some network file systems answer; any other answer is a fault of the disk."""
    sync = os.fsync

    def of_files_only(file: int) -> None:
        if Path(f"/dev/fd/{file}").resolve().is_dir():
            raise OSError(answer, os.strerror(answer))
        sync(file)

    monkeypatch.setattr(os, "fsync", of_files_only)
    if whole:
        files.write_atomically(tmp_path / "file", b"1")
    else:
        with pytest.raises(OSError, match=os.strerror(answer)):
            files.write_atomically(tmp_path / "file", b"1")
    assert (tmp_path / "file").read_bytes() == b"1"


@pytest.mark.parametrize("answer", [None, errno.EOPNOTSUPP, errno.EINVAL])
def test_space_is_reserved_where_the_system_cannot(
    answer: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By zeros, as on macOS and some file systems; what is there stays."""

    def refuse(*arguments: Any) -> None:
        assert answer is not None
        raise OSError(answer, os.strerror(answer))

    if answer is None:
        monkeypatch.delattr(os, "posix_fallocate")
    else:
        monkeypatch.setattr(os, "posix_fallocate", refuse)
    (tmp_path / "file").write_bytes(b"rows")
    with (tmp_path / "file").open("r+b") as file:
        files.reserve(file.fileno(), 3_000_001)
    assert (tmp_path / "file").read_bytes() == b"rows" + bytes(2_999_997)
    assert (tmp_path / "file").stat().st_blocks * 512 >= 3_000_001


def test_a_full_disk_reserves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with (tmp_path / "file").open("w+b") as file, pytest.raises(OSError, match="No space"):
        files.reserve(file.fileno(), 100)


def link_to_a_file(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(b"another's")
    path.symlink_to(other)


ODD: dict[str, Callable[[Path], object]] = {
    "link": link_to_a_file,
    "link to nowhere": lambda path: path.symlink_to("nowhere"),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("mode", ["rb", "ab", "r+b", "w"])
def test_what_is_no_file_is_not_opened(kind: str, mode: str, tmp_path: Path) -> None:
    """Nor followed, nor waited for."""
    ODD[kind](tmp_path / "file")
    with pytest.raises(OSError, match="is not a regular file"):
        open(tmp_path / "file", mode, opener=files.regular)  # noqa: SIM115
    with pytest.raises(UsageError, match="file: cannot be read: is not a regular file"):
        storage.read(tmp_path / "file", "thing")
    if kind == "link":
        assert (tmp_path / "other").read_bytes() == b"another's"


def test_a_link_is_replaced_not_written_through(tmp_path: Path) -> None:
    """Also where the temporary file would lie."""
    link_to_a_file(tmp_path / "file")
    (tmp_path / f"file{files.TEMPORARY}").symlink_to("other")
    files.write_atomically(tmp_path / "file", b"own", tmp_path / "before")
    assert files.read_bytes(tmp_path / "file") == b"own"
    assert (tmp_path / "other").read_bytes() == b"another's"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "other"]


def test_a_write_that_fails_leaves_no_litter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        files.write_atomically(tmp_path / "file", b"1")
    assert not [*tmp_path.iterdir()]


def _write_half(name: Path, fail: type[BaseException] | None) -> None:
    name.write_bytes(b"ne")
    if fail is not None:
        raise fail("in the middle")
    name.write_bytes(b"new")


@pytest.mark.parametrize("fail", [None, OSError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, b"old"])
def test_a_file_that_another_library_writes_is_replaced_whole(
    fail: type[BaseException] | None, before: bytes | None, tmp_path: Path
) -> None:
    file = tmp_path / "film.mp4"
    if before is not None:
        file.write_bytes(before)
    (tmp_path / f"film{files.TEMPORARY}.mp4").symlink_to(tmp_path / "elsewhere")
    with suppress(OSError, KeyboardInterrupt), files.replacing(file) as name:
        assert name.suffix == ".mp4"
        _write_half(name, fail)
    found = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    kept = b"new" if fail is None else before
    assert found == ({} if kept is None else {"film.mp4": kept})


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="directory"), files.replacing(tmp_path):
        raise AssertionError("nothing is to be written")

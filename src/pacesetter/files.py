"""Files that are opened without trust and replaced whole, whatever happens meanwhile.

Every file of a run's folder is opened, read and replaced by the functions here.
"""

import errno
import os
import stat
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY = ".pacesetter-tmp"
NOT_REGULAR = "is not a regular file"
# What opening answers for a link, a pipe that nobody reads, and a folder.
_ODD = {errno.ELOOP, errno.EMLINK, errno.ENXIO, errno.EISDIR}
_NO_RESERVE = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
_NO_LINKS = {errno.EPERM, errno.EACCES, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EMLINK}


def regular(path: str | Path, flags: int) -> int:
    """Open a regular file, as `opener` of `open`: follow no link, wait for no pipe.

    Raises OSError for a link, a folder, a pipe or a device.
    """
    try:
        file = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if error.errno in _ODD:
            raise OSError(errno.EINVAL, NOT_REGULAR, str(path)) from None
        raise
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, NOT_REGULAR, str(path))
    return file


def reserve(file: int, size: int) -> None:
    """Make an open file `size` bytes long, with zeros and real blocks behind them.

    Without blocks, a full disk would kill the process at a later write to a map of the file.
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(file, 0, size)
            return
        except OSError as error:
            if error.errno not in _NO_RESERVE:
                raise
    zeros = bytes(2**20)
    for start in range(os.fstat(file).st_size, size, len(zeros)):
        os.pwrite(file, zeros[: size - start], start)


def read_bytes(path: Path) -> bytes:
    """All bytes of a regular file."""
    with open(path, "rb", opener=regular) as file:
        return file.read()


def present(path: Path) -> bool:
    """Whether anything has this name, be it a link that leads nowhere."""
    return os.path.lexists(path)


def is_regular(path: Path) -> bool:
    """Whether a regular file, no link to one, has this name."""
    return present(path) and stat.S_ISREG(path.lstat().st_mode)


def write_atomically(path: Path, data: bytes, keep: Path | None = None) -> None:
    """Replace a file so that a kill or a power cut leaves the old or the new one, never a part.

    `keep` is where the replaced file stays reachable.
    """
    temporary = path.with_name(path.name + TEMPORARY)
    temporary.unlink(missing_ok=True)
    try:
        with open(temporary, "xb", opener=regular) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if keep is not None and is_regular(path):
            link(path, keep)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """The name of a new file, with the same ending, that takes the place of `path` once written.

    For writers that take a name. If one fails, what was there stays and nothing is left over.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    temporary = path.with_name(f"{path.stem}{TEMPORARY}{path.suffix}")
    temporary.unlink(missing_ok=True)
    open(temporary, "xb", opener=regular).close()  # a refusal comes here, before the work
    try:
        yield temporary
        with open(temporary, "rb", opener=regular) as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def make_folder(path: Path) -> bool:
    """Make a folder, and its name safe from a power cut; False if it was there."""
    if path.is_dir():
        return False
    try:
        path.mkdir()
    except FileExistsError:
        if not path.is_dir():
            raise
        return False
    try:
        sync_folder(path.parent)
    except BaseException:
        path.rmdir()
        raise
    return True


def sync_folder(path: Path) -> None:
    """Make the names in a folder safe from a power cut."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno != errno.EINVAL:  # the answer of file systems that sync files alone
            raise
    finally:
        os.close(folder)


def link(path: Path, to: Path) -> None:
    """Give a file a second name, in place of what had that name.

    Where the file system knows no second names, the file gets the new name alone.
    """
    temporary = to.with_name(to.name + TEMPORARY)
    temporary.unlink(missing_ok=True)
    try:
        os.link(path, temporary)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        path.replace(to)
    else:
        temporary.replace(to)

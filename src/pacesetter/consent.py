"""Consent: a name that a file gives imports no module, unless the command line names it too."""

import sys
from collections.abc import Container, Iterable

from pacesetter.errors import SHOWN, UsageError

FLAG = "--allow"


def require(
    kind: str,
    name: str,
    allowed: Iterable[str | None] = (),
    loaded: Container[str] = sys.modules,
    how: str | None = None,
) -> None:
    """Refuse a name from a file, such as `module:Id-v0`, that would import a module unasked.

    `allowed` are the names that the caller gave himself. A module that is `loaded` already, as by
    a Python program that uses it, is not imported again. `how` is the flag that allows it, where
    that is not `--allow`. Raises UsageError.
    """
    module, colon, _ = _base(name).partition(":")
    if not colon or module in loaded or _base(name) in map(_base, filter(None, allowed)):
        return
    raise UsageError(
        f"{kind}: a file names '{name}', which would import a module, and so run its code; "
        f"if you trust it, allow it with {how or f'{FLAG} {name}'}"
    )


def require_all(
    kind: str, names: object, allowed: Iterable[str | None] = (), flag: str | None = None
) -> None:
    """`require` for a list of names that a file gives. Raises UsageError if it is no such list.

    `flag` is one that takes the whole list, where a command has that in place of `--allow`.
    """
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise UsageError(f"{kind}: must be a list of names, got {str(names)[:SHOWN]}")
    how = " ".join([flag, *map(str, names)]) if flag else None
    for name in names:
        require(kind, str(name), allowed, how=how)


def words(*names: str) -> list[str]:
    """The flags that allow those of the names that import a module."""
    return [word for name in names if ":" in name for word in (FLAG, name)]


def _base(name: str) -> str:
    return name.removeprefix("multi-")

"""Optional packages, imported when they are needed."""

import importlib
from importlib.util import find_spec
from typing import Any

from pacesetter.errors import UsageError


def need(what: str, module: str, install: str) -> Any:
    """The module, or one line that says what `pip install` brings it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise _missing(what, module, install) from None


def look_for(what: str, module: str, install: str) -> None:
    """Refuse as `need` does, without the seconds that importing takes."""
    if find_spec(module) is None:
        raise _missing(what, module, install)


def _missing(what: str, module: str, install: str) -> UsageError:
    name = module.split(".")[0]
    return UsageError(f"{what}: {name} is not installed; pip install '{install}'")

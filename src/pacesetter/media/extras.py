"""Optional packages, imported when they are needed."""

import importlib
from typing import Any

from pacesetter.errors import UsageError


def need(what: str, module: str, install: str) -> Any:
    """The module, or one line that says what `pip install` brings it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        name = module.split(".")[0]
        raise UsageError(f"{what}: {name} is not installed; pip install '{install}'") from None

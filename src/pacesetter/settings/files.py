"""Settings from a file of the user's: TOML, JSON, or the config.json of a run."""

import json
import tomllib
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.settings import Settings


def read_file(path: Path, name: str | None = None) -> Settings:
    """Settings from a TOML or JSON file, or from a run's config.json.

    The latter is refused if `name` is neither its algorithm nor its name. Raises UsageError.
    """
    try:
        text = path.read_text("utf-8-sig")
        table: Any = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"config: cannot read {path}: {error}") from None
    if not isinstance(table, dict):
        raise UsageError(f"config: {path} must hold a table of settings")
    found: Any = table.get("settings", table)
    if not isinstance(found, dict):
        raise UsageError(f"config: settings in {path} must be a table")
    whole = [found.get("algorithm"), found.get("name")] if "settings" in table else [name]
    if name is not None and name not in whole:
        raise UsageError(
            f"config: {path} holds all settings of a run of {found.get('algorithm')}; "
            f"they cannot be those of {name}"
        )
    return {key.replace("-", "_"): value for key, value in found.items()}

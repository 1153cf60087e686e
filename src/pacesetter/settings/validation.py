"""Checked settings: the fields of a settings class, and its instances made or refused."""

import re
from collections.abc import Iterable
from typing import Any, get_args

from pydantic import ValidationError

from pacesetter.errors import UsageError, unknown
from pacesetter.settings import Settings


def fields_of(kind: type) -> dict[str, Any]:
    """The fields of a settings class by name: pydantic's annotation, default, range and help."""
    return vars(kind)["__pydantic_fields__"]


def build(kind: type, table: Settings) -> Any:
    """Make checked settings, or refuse them in one line that names the field."""
    infos = fields_of(kind)
    for key, value in table.items():  # Python, and so pydantic, takes True for 1
        annotation = infos[key].annotation
        if isinstance(value, bool) and {int, float} & {annotation, *get_args(annotation)}:
            raise UsageError(f"{key}: should be a number, got {str(value).lower()}")
    try:
        return kind(**table)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"][:1])
        if first["type"] == "literal_error":
            options = re.findall(r"'([^']*)'", first.get("ctx", {})["expected"])
            raise unknown(field, str(first["input"]), options) from None
        message = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
        raise UsageError(f"{field}: {message}, got {first['input']!r}") from None


def difference(old: Settings, new: Settings, keys: Iterable[str]) -> str | None:
    """The first of the keys whose values differ, such as `gamma=0.9, not 0.99`."""
    for key in keys:
        if old.get(key) != new.get(key):
            return f"{key}={old.get(key)}, not {new.get(key)}"
    return None

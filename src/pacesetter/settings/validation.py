"""Checked settings: the fields of a settings class, and its instances made or refused."""

import json
import re
from collections.abc import Iterable
from functools import cache
from typing import Annotated, Any, get_args

from pydantic import Field, TypeAdapter, ValidationError

from pacesetter.errors import SHOWN, UsageError, unknown
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


Natural = Annotated[int, Field(ge=0, le=10**15)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def check(kind: Any, table: Any) -> Any:
    """What a file's table holds as a kind of values, with no type taken for another.

    Raises a ValueError that names the field, for the reader of the file to add its path.
    """
    try:
        return _adapter(kind).validate_json(json.dumps(table), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        parts = [str(part) for part in first["loc"]]
        field = ".".join(part for part in parts if part.isidentifier() or part.isdecimal()) or "it"
        if first["type"] == "missing":
            raise ValueError(f"{field} is missing") from None
        message = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
        raise ValueError(f"{field}: {message}, got {str(first['input'])[:SHOWN]}") from None


def difference(old: Settings, new: Settings, keys: Iterable[str]) -> str | None:
    """The first of the keys whose values differ, such as `gamma=0.9, not 0.99`."""
    for key in keys:
        if old.get(key) != new.get(key):
            return f"{key}={old.get(key)}, not {new.get(key)}"
    return None

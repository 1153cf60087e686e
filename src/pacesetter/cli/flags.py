"""Command-line flags read off the settings classes: names, help, ranges and defaults."""

import argparse
import tomllib
from dataclasses import fields
from typing import Any, Literal, NoReturn, get_args, get_origin

from pacesetter.errors import UsageError, unknown
from pacesetter.settings import Settings

_POSITIONAL = {"algorithm", "env", "env_kwargs"}
_BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below", "min_length": "length"}


class Parser(argparse.ArgumentParser):
    """argparse whose errors are one line and whose unknown flags are met with the nearest ones."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message[:1].lower()}{message[1:]}; see `{self.prog} --help`")

    def parse(self, arguments: list[str]) -> argparse.Namespace:
        """Parse all arguments, or refuse the first one that is not known."""
        found, rest = self.parse_known_args(arguments)
        for word in rest:
            if word.startswith("-"):
                flag = word.split("=")[0]
                raise unknown("flag", flag, self._option_string_actions, f"{self.prog} --help")
        if rest:
            raise UsageError(f"argument: '{rest[0]}' is one too many; see `{self.prog} --help`")
        return found

    def knows(self, flag: str) -> bool:
        """Whether a flag has been added."""
        return flag in self._option_string_actions


def parser(prog: str, description: str) -> Parser:
    """A parser that takes flags in full only, so that new flags never change what a line means."""
    return Parser(prog=f"pacesetter {prog}", description=description, allow_abbrev=False)


def add_settings(command: Parser, title: str, kind: type, defaults: Settings | None) -> None:
    """A group of flags: one for each field of a settings class, with help, range and default.

    Without defaults, for settings of several algorithms, one flag serves all that have it.
    """
    into = command.add_argument_group(title)
    infos: dict[str, Any] = kind.__dict__["__pydantic_fields__"]
    for field in fields(kind):
        flag = "--" + field.name.replace("_", "-")
        if field.name in _POSITIONAL or (defaults is None and command.knows(flag)):
            continue
        info = infos[field.name]
        words = [info.description, *_allowed(info)]
        words += [] if defaults is None else [f"default {_show(defaults[field.name])}"]
        options: dict[str, Any] = {
            "help": (words[0] + f" ({'; '.join(words[1:])})" * bool(words[1:])).replace("%", "%%"),
            "default": argparse.SUPPRESS,
            "dest": field.name,
        }
        if info.annotation is bool:
            options["action"] = argparse.BooleanOptionalAction
        elif get_origin(info.annotation) is tuple:
            options |= {"nargs": "+", "metavar": "N"}
        else:
            options["metavar"] = "X"
        into.add_argument(flag, **options)


def split_env_kwargs(arguments: list[str]) -> tuple[list[str], Settings]:
    """Take `--env.KEY VALUE` and `--env.KEY=VALUE` out of the arguments."""
    rest: list[str] = []
    kwargs: Settings = {}
    words = iter(arguments)
    for word in words:
        if not word.startswith("--env."):
            rest.append(word)
            continue
        key, has_value, value = word.removeprefix("--env.").partition("=")
        text = value if has_value else next(words, None)
        if text is None or not key:
            raise UsageError(f"flag: {word} needs a value: --env.KEY VALUE")
        kwargs[key.replace("-", "_")] = _value(text)
    return rest, kwargs


def _value(text: str) -> Any:
    if text.lower() in ("true", "false", "none"):
        return {"true": True, "false": False, "none": None}[text.lower()]
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, (int, float, str, list)) else text


def _allowed(info: Any) -> list[str]:
    annotation = info.annotation
    if get_origin(annotation) is Literal:
        return [" or ".join(str(choice) for choice in get_args(annotation))]
    words: list[str] = []
    for mark in info.metadata:
        for name, word in _BOUNDS.items():
            if hasattr(mark, name):
                words.append(f"{word} {getattr(mark, name)}")
    return words


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, (tuple, list)):
        return " ".join(str(part) for part in value)
    return "none" if value is None else str(value)

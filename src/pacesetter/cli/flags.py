"""Command-line flags read off the settings classes: names, help, ranges and defaults."""

import argparse
import json
import sys
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any, ClassVar, Literal, NoReturn, get_args, get_origin

from pacesetter import consent
from pacesetter.errors import UsageError, unknown
from pacesetter.settings import Settings
from pacesetter.settings.validation import fields_of
from pacesetter.tracking import NONE, SINKS

RUNS = "runs"
_POSITIONAL = {"algorithm", "env", "env_kwargs"}
_BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


class Parser(argparse.ArgumentParser):
    """An argparse parser with one-line errors, which names the flags nearest to an unknown one."""

    kept: ClassVar[list["Parser"] | None] = None  # if a list, it gets parsers instead of their help

    def print_help(self, file: Any = None) -> None:
        if Parser.kept is None:
            super().print_help(file)
        else:
            Parser.kept.append(self)

    def mark(self, name: str, values: dict[str, Any]) -> None:
        """Give the arguments that are named an attribute, for completion by a shell."""
        for action in self._actions:
            if action.dest in values:
                setattr(action, name, values[action.dest])

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
        names = (getattr(found, each, None) or () for each in ("allow", "env", "envs", "wrap"))
        look_here(*(name for each in names for name in ([each] if isinstance(each, str) else each)))
        return found

    def knows(self, flag: str) -> bool:
        """Whether a flag has been added."""
        return flag in self._option_string_actions

    def add_runs(self) -> None:
        """`--runs`, the folder of all runs."""
        about = f"folder of runs (default {RUNS})"
        self.add_argument("--runs", default=RUNS, metavar="DIR", help=about)

    def add_allow(self) -> None:
        """`--allow`, for verbs that read names of tasks or algorithms from files."""
        about = (
            "import the module of NAME, such as module:Id-v0, which a file names and you trust; "
            "may be repeated"
        )
        self.add_argument(consent.FLAG, action="append", default=[], metavar="NAME", help=about)

    def add_quiet(self) -> None:
        """`--quiet`, for verbs that show progress."""
        self.add_argument("-q", "--quiet", action="store_true", help="show no progress")

    def add_log(self) -> None:
        """`--log`, for verbs that train."""
        tools = f"{', '.join(SINKS)} or {NONE}; default none, or those of a resumed run"
        about = f"also send the log to these trackers, separated by commas ({tools})"
        self.add_argument("--log", metavar="TOOLS", help=about)

    def add_env_keywords(self) -> None:
        """`--env.KEY` in the help; `split_env_kwargs` takes it out of the words before parsing."""
        self.add_argument("--env.KEY", metavar="VALUE", help="keyword for the env's constructor")


def parser(prog: str, description: str) -> Parser:
    """A parser that takes whole flags only: then a new flag never changes what a command means."""
    return Parser(prog=f"pacesetter {prog}", description=description, allow_abbrev=False)


def look_here(*names: str | None) -> None:
    """Find modules that the command line names in the current folder too, after all others."""
    if any(":" in name for name in names if name) and (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)


def algorithm_and_env(command: Parser, words: list[str]) -> tuple[str, str, list[str]]:
    """The first two words of `train` and `tune`, and the rest; without them, help or a refusal."""
    given = [word for word in words[:2] if not word.startswith("-")]
    if len(given) == 2:
        look_here(*given)
        return given[0], given[1], words[2:]
    command.add_argument("ALGO", help="algorithm or preset; see `pacesetter list algorithms`")
    command.add_argument("ENV", help="Gymnasium id such as HalfCheetah-v5, or module:Id-v0")
    command.epilog = f"`{command.prog} ALGO ENV --help` lists every setting with its default."
    command.usage = f"{command.prog} ALGO ENV [--SETTING VALUE ...]"
    if not {"-h", "--help"} & {*words} and len(words) >= 2:
        raise UsageError(f"{command.prog.split()[-1]}: ALGO and ENV come first, then settings")
    command.parse(words)
    raise AssertionError("argparse ends on too few words")


def add_settings(
    command: Parser,
    title: str,
    kind: type,
    defaults: Settings | None,
    hidden: Collection[str] = (),
) -> None:
    """A group of flags: one for each field of a settings class, with help, range and default.

    Without defaults, for settings of several algorithms, one flag serves all that have it. Hidden
    flags are parsed, so that their refusal says why, but are not in the help.
    """
    group = command.add_argument_group(title)
    for name, info in fields_of(kind).items():
        flag = "--" + name.replace("_", "-")
        if name in _POSITIONAL or (defaults is None and command.knows(flag)):
            continue
        options: dict[str, Any] = {"default": argparse.SUPPRESS, "dest": name}
        options["help"] = argparse.SUPPRESS if name in hidden else _help(name, info, defaults)
        if info.annotation in (bool, bool | None):
            options["action"] = argparse.BooleanOptionalAction
        elif info.annotation == tuple[str, ...]:
            options |= {"action": "extend", "nargs": "+", "metavar": "MODULE:CLASS"}
        elif get_origin(info.annotation) is tuple:
            options |= {"nargs": "+", "metavar": "N"}
        elif get_origin(info.annotation) is dict:
            options |= {"action": "append", "metavar": "NAME=X,X"}
        else:
            options["metavar"] = "X"
        group.add_argument(flag, **options)


def _help(name: str, info: Any, defaults: Settings | None) -> str:
    """Description (range; default X); the description itself says what a default of None means."""
    notes = _allowed(info)
    if defaults is not None and defaults[name] not in (None, {}, ()):
        notes.append(f"default {_show(defaults[name])}")
    text = f"{info.description} ({'; '.join(notes)})" if notes else info.description
    return text.replace("%", "%%")


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
    except (tomllib.TOMLDecodeError, RecursionError):
        return _json(text)
    return value if isinstance(value, (int, float, str, list, dict)) else text


def _json(text: str) -> Any:
    """A table, list or word as JSON writes it, or else the text."""
    try:
        return json.loads(text) if text.startswith(("{", "[", '"')) else text
    except (ValueError, RecursionError):
        return text


def _allowed(info: Any) -> list[str]:
    """What a setting may be: its choices, or its range."""
    annotation = info.annotation
    if get_origin(annotation) is Literal:
        *others, last = map(str, get_args(annotation))
        return [f"{', '.join(others)} or {last}" if others else last]
    return [
        f"{word} {getattr(mark, name)}"
        for mark in info.metadata
        for name, word in _BOUNDS.items()
        if hasattr(mark, name)
    ]


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, (tuple, list)):
        return " ".join(str(part) for part in value)
    return str(value)

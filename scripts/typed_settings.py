"""Write src/pacesetter/settings/typed.py, by which an editor completes the settings of `Trainer`.

python scripts/typed_settings.py            # after a setting, an algorithm or a preset has changed
"""

import re
from pathlib import Path
from textwrap import fill
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BeforeValidator

from pacesetter import algorithms
from pacesetter.config import Run, presets
from pacesetter.settings.validation import fields_of

FILE = Path(__file__).parents[1] / "src" / "pacesetter" / "settings" / "typed.py"
GIVEN = {"algorithm", "env"}  # arguments of their own
HEAD = '''"""Settings of a run as an editor sees them: written by scripts/typed_settings.py."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

'''
TAIL = '''


class TrainerSettings(RunSettings, total=False):
    """And the folder of runs, and a file of settings."""

    runs: str | Path
    config: str | Path | None
'''
WIDTH = 100
INDENT = "    "
PLAIN: Any = {"subsequent_indent": INDENT, "break_on_hyphens": False}


def text() -> str:
    """The whole module."""
    kinds = [Run, *(algorithms.find(name).Hyper for name in algorithms.TABLE)]
    found: dict[str, tuple[list[str], str]] = {}
    for kind in kinds:
        for name, info in fields_of(kind).items():
            types, about = found.setdefault(name, ([], info.description or ""))
            types += [one for one in spell(info.annotation, info.metadata) if one not in types]
    known = fill(", ".join(map(quoted, names())), WIDTH, initial_indent=INDENT, **PLAIN)
    lines = [f"{HEAD}# fmt: off", "Name = Literal[", known, "]", "# fmt: on", "", ""]
    lines += ["class RunSettings(TypedDict, total=False):"]
    lines += [
        '    """What `Trainer` takes besides algorithm and env, whichever algorithm has it."""',
        "",
    ]
    for name, (types, about) in found.items():
        if name not in GIVEN:
            lines += [f"    {name}: {' | '.join(simplest(types))}", f'    """{shortened(about)}"""']
    return "\n".join(lines) + TAIL


def names() -> list[str]:
    """All names that `train` takes for an algorithm."""
    own = [*algorithms.TABLE]
    several = [f"multi-{name}" for name in own if not algorithms.single_member(name)]
    return [*own, *several, *presets()]


def spell(annotation: Any, metadata: Any = ()) -> list[str]:
    """The types that a field takes, as written in code: a count may also be a word, such as 1M."""
    words = ["str"] if any(isinstance(mark, BeforeValidator) for mark in metadata) else []
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return spell(parts[0], parts[1:])
    if origin in (Union, UnionType):
        return [one for part in parts for one in spell(part)]
    if origin is Literal:
        return [f"Literal[{', '.join(map(quoted, parts))}]"]
    if origin is tuple:
        return [f"Sequence[{spell(parts[0])[0]}]"]
    if origin is dict:
        return ["dict[str, Any]"]
    return ["None" if annotation is NoneType else annotation.__name__, *words]


def quoted(word: str) -> str:
    return f'"{word}"'


def simplest(types: list[str]) -> list[str]:
    """Without what another type includes: a literal beside `str`, or beside a longer literal."""
    kept = [one for one in types if not ("str" in types and one.startswith("Literal"))]
    words = {one: {*re.findall(r'"([^"]*)"', one)} for one in kept if one.startswith("Literal")}
    longest = [
        one for one in kept if not any(words.get(one, {""}) < more for more in words.values())
    ]
    return sorted(longest, key=lambda one: one == "None")


def shortened(about: str) -> str:
    """A description in one line."""
    room = WIDTH - 10
    return about if len(about) <= room else about[: about.rindex(" ", 0, room - 3)] + "..."


if __name__ == "__main__":
    FILE.write_text(text(), "utf-8")
    print(FILE)

"""What `make docs` adds to docs/: the reference, from the program itself, and linked source files.

MkDocs calls the functions that begin with on_ (`hooks` in mkdocs.yml).
"""

import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import pacesetter

ROOT = Path(__file__).parents[1]
TASK = "HalfCheetah-v5"
NOUNS = ("algorithms", "presets", "rules", "suites")
LINK = re.compile(r"\]\(((?:\.\./)+)([\w./-]+)\)")
LANGUAGES = {".py": "python", ".toml": "toml", ".ipynb": "json", ".jsonl": "json"}
MODULES = re.compile(r"\b(?:[a-z_]+\.)+(?=[A-Z])")  # before the names of classes
ELSEWHERE = (  # public too, each imported from its own module
    "pacesetter.media.record.record",
    "pacesetter.media.poster.poster",
    "pacesetter.media.watch.watch",
    "pacesetter.media.export.export",
    "pacesetter.media.sb3.SB3Policy",
    "pacesetter.media.hub.push",
    "pacesetter.media.hub.load_from_hub",
    "pacesetter.tracking.tracked",
)
NO_SEARCH = "---\nsearch: { exclude: true }\n---\n\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {
        "reference/cli.md": command_line(),
        "reference/settings.md": settings(),
        "reference/python.md": python(),
    }
    for page in files.documentation_pages():
        pages |= {source_page(path): source(path) for path in linked(page.content_string, page)}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links that leave docs/ at the pages of those files."""

    def point(found: re.Match[str]) -> str:
        path = outside(page.file, found)
        if path is None:
            return found[0]
        return f"]({os.path.relpath(source_page(path), Path(page.file.src_uri).parent)})"

    return LINK.sub(point, markdown)


def linked(markdown: str, file: File) -> Iterator[Path]:
    """The repository's files outside docs/ that a page links to."""
    for found in LINK.finditer(markdown):
        path = outside(file, found)
        if path is not None:
            yield path


def outside(file: File, link: re.Match[str]) -> Path | None:
    """Which file of the repository a link means; None if it is in docs/ or is not there."""
    path = (ROOT / "docs" / file.src_uri).parent / link[1] / link[2]
    path = path.resolve()
    if not path.is_file() or path.is_relative_to(ROOT / "docs"):
        return None
    return path.relative_to(ROOT)


def source_page(path: Path) -> str:
    """The name of a source file's page."""
    return f"source/{path}.md"


def source(path: Path) -> str:
    """A source file as a page."""
    text = (ROOT / path).read_text("utf-8")
    return f"{NO_SEARCH}# {path}\n\n{fence(text, LANGUAGES.get(path.suffix, 'text'))}"


def fence(text: str, language: str = "text") -> str:
    """A code block that its own text cannot end."""
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    ticks = "`" * max(3, longest + 1)
    return f"{ticks}{language}\n{text.rstrip()}\n{ticks}\n"


# The command line.


def command_line() -> str:
    """Every verb's help, and what `list` lists."""
    from pacesetter.cli.main import VERBS

    commands = [["--help"], *([verb, "--help"] for verb in VERBS), *(["list", n] for n in NOUNS)]
    parts = [
        "# Command line\n\nAs this version prints it. [Settings](settings.md) has the flags of "
    ]
    parts += ["each algorithm.\n"]
    for words, text in zip(commands, printed(commands), strict=True):
        title = " ".join(word for word in words if word != "--help")
        parts.append(f"\n## pacesetter {title}".rstrip() + "\n\n" + fence(text))
    return "".join(parts)


def settings() -> str:
    """Every algorithm's flags, defaults and ranges."""
    from pacesetter.algorithms import TABLE

    commands = [["train", name, TASK, "--help"] for name in TABLE]
    parts = [
        f"# Settings\n\nWhat `pacesetter train ALGO {TASK} --help` prints for each algorithm. "
    ]
    parts += ["Defaults may differ on other tasks.\n"]
    for name, text in zip(TABLE, printed(commands), strict=True):
        flags = text[text.index("\n\n") :].strip()  # the usage names each flag once more
        parts.append(f"\n## {name}\n\n" + fence(flags))
    return "".join(parts)


def printed(commands: list[list[str]]) -> list[str]:
    """What each command prints; one that fails stops the build."""

    def run(words: list[str]) -> str:
        command = [sys.executable, "-m", "pacesetter", *words]
        environment = os.environ | {"COLUMNS": "88"}
        result = subprocess.run(command, env=environment, capture_output=True, text=True)
        if result.returncode:
            raise RuntimeError(f"`pacesetter {' '.join(words)}`: {result.stderr}")
        return result.stdout

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(run, commands))


# The Python names.


def python() -> str:
    """The public names with their signatures and docstrings, and the classes that they give."""
    public = {name: getattr(pacesetter, name) for name in pacesetter.__all__}
    given = {kind.__name__: kind for thing in public.values() for kind in gives(thing)}
    rest = {name: kind for name, kind in given.items() if kind not in public.values()}
    line = f"`from pacesetter import {', '.join(public)}`"
    below = "Below them are the classes that they give, and what other modules have."
    start = f"# Python\n\n{line}\n\n{below}\n"
    parts = [entry(name, thing) for name, thing in (public | rest).items()]
    for place in ELSEWHERE:
        module, name = place.rsplit(".", 1)
        text = entry(name, getattr(import_module(module), name))
        parts.append(text.replace("\n\n", f"\n\n`from {module} import {name}`\n\n", 1))
    return start + "".join(parts)


def gives(thing: Any) -> list[type]:
    """Classes of this package in the return types of a function, or of a class's methods."""
    functions = [thing, *(member for _, member in inspect.getmembers(thing, inspect.isfunction))]
    found = [get_type_hints(function).get("return") for function in functions]
    flat = [part for kind in found for part in (kind, *get_args(kind))]
    own = [part for part in flat if getattr(part, "__module__", "").startswith("pacesetter.")]
    return [kind for kind in dict.fromkeys(own) if inspect.isclass(kind)]


def entry(name: str, thing: Any) -> str:
    """One function or class, with the public methods of the class."""
    parts = [f"\n## {name}\n\n", signature(name, inspect.signature(thing)), described(thing)]
    if inspect.isclass(thing):
        parts += [method(name, *member) for member in vars(thing).items()]
    return "".join(parts)


def method(owner: str, name: str, member: Any) -> str:
    """A public method or property, if it is one."""
    function = getattr(member, "__func__", member)
    shown = not name.startswith("_") or name in ("__call__", "__iter__")
    if not shown or not (isinstance(member, property) or inspect.isfunction(function)):
        return ""
    title = f"\n### `{owner}.{name}`\n\n"
    if isinstance(member, property):
        return title + described(member)
    found = inspect.signature(function)
    own = list(found.parameters.values())[1:]  # without self
    return title + signature(name, found.replace(parameters=own)) + described(function)


def signature(name: str, found: inspect.Signature) -> str:
    """The call as Python would write it, a parameter a line where it is long."""
    line = f"{name}{found}"
    if len(line) > 80:
        empty = found.replace(parameters=[])
        line = "\n    ".join([f"{name}(", *parameters(found)]) + f"\n{str(empty)[1:]}"
    return fence(MODULES.sub("", line).removesuffix(" -> None"), "python") + "\n"


def parameters(found: inspect.Signature) -> Iterator[str]:
    """Each parameter, and the star before those that need their name."""
    starred = False
    for parameter in found.parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not starred:
            starred = True
            yield "*,"
        yield f"{parameter},"


def described(thing: Any) -> str:
    """The docstring."""
    return f"{inspect.getdoc(thing) or ''}\n"

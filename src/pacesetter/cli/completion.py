"""The verb `completion`: a shell's script for what Tab completes."""

from argparse import ArgumentParser
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Literal, get_args, get_origin

from pacesetter.cli.flags import RUNS, Parser, add_settings, parser
from pacesetter.errors import unknown

SHELLS = ("bash", "zsh", "tcsh")
INSTALL = "pacesetter[completion]"
# Names of runs, as `find` takes them: env/name/seed.
NAMES = f'$(cd {RUNS} 2>/dev/null && printf "%s\\n" */*/[0-9]*)'
PREAMBLE = {
    "bash": f'_pacesetter_runs() {{ compgen -W "{NAMES}" -- "$1"; compgen -f -- "$1"; }}',
    "zsh": f'_pacesetter_runs() {{ compadd -- ${{(f)"{NAMES}"}}; _files }}',
}
RUN = {"bash": "_pacesetter_runs", "zsh": "_pacesetter_runs"}


def completion(words: list[str]) -> int:
    """Print the script by which Tab completes in bash, zsh or tcsh."""
    from pacesetter.media.extras import need

    command = parser("completion", "Print a script for a shell, so that Tab completes pacesetter.")
    command.add_argument("shell", metavar="|".join(SHELLS), help="shell that reads the script")
    command.epilog = 'bash: eval "$(pacesetter completion bash)", such as in ~/.bashrc'
    found = command.parse(words)
    if found.shell not in SHELLS:
        raise unknown("shell", found.shell, SHELLS)
    shtab = need("completion", "shtab", INSTALL)
    print(shtab.complete(_tree(shtab), shell=found.shell, preamble=PREAMBLE))
    return 0


def _tree(shtab: Any) -> ArgumentParser:
    """All verbs under one parser, with what each argument may be."""
    from pacesetter.cli.main import VERBS

    root = ArgumentParser(prog="pacesetter")
    below = root.add_subparsers()
    completed = {
        **dict.fromkeys(("o", "config", "study"), shtab.FILE),
        "runs": shtab.DIRECTORY,
        "run": RUN,
    }
    for verb, function in VERBS.items():
        parents = _parents(verb, function)
        for one in parents:
            one.mark("complete", completed)
        about = (function.__doc__ or "").strip()
        below.add_parser(verb, parents=parents, add_help=False, help=about)
    return root


def _parents(verb: str, function: Callable[[list[str]], int]) -> list[Parser]:
    """What a verb parses its words with, and what these may be."""
    if verb in ("train", "tune"):
        return _training(function)
    from pacesetter.cli.listing import LISTS
    from pacesetter.media.export import TARGETS
    from pacesetter.study.bench.suite import shipped

    found, first = _asked(function, []), Parser(add_help=False)
    choices = {"shell": SHELLS, "kind": (*LISTS, "runs"), "to": (*TARGETS,)}
    found.mark("choices", choices)
    if verb == "bench":
        first.add_argument("suite", nargs="?", choices=shipped())
    return [first, found]


def _training(function: Callable[[list[str]], int]) -> list[Parser]:
    """Algorithm and env, then the settings of every algorithm."""
    from pacesetter import algorithms
    from pacesetter.config import Run, presets
    from pacesetter.envs import known
    from pacesetter.settings.validation import fields_of

    first, names = Parser(add_help=False), algorithms.names()
    several = [f"multi-{name}" for name in names if not algorithms.single_member(name)]
    first.add_argument("algorithm", choices=[*names, *several, *presets()])
    first.add_argument("env", choices=known())
    found = _asked(function, ["td3", "HalfCheetah-v5"])
    for kind in [Run, *(algorithms.find(name).Hyper for name in names)]:
        add_settings(found, "settings", kind, None)
        words = {name: _words(info.annotation) for name, info in fields_of(kind).items()}
        found.mark("choices", {name: one for name, one in words.items() if one})
    return [first, found]


def _words(annotation: Any) -> tuple[str, ...]:
    """The words that a setting is one of, if it is."""
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def _asked(function: Callable[[list[str]], int], words: Iterable[str]) -> Parser:
    """The parser whose help a verb would print."""
    Parser.kept = []
    try:
        with suppress(SystemExit):
            function([*words, "--help"])
        return Parser.kept[0]
    finally:
        Parser.kept = None

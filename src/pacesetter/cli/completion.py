"""The verb `completion`: a shell's script for what Tab completes."""

from argparse import ArgumentParser
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Literal, get_args, get_origin

from pacesetter.cli.flags import RUNS, Parser, add_settings, parser
from pacesetter.errors import unknown

SHELLS = ("bash", "zsh", "tcsh")
INSTALL = "pacesetter[completion]"
# Names of runs, as `find` takes them (env/name/seed), and files. Folders may come from others: bash
# quotes their names, so that none is ever run as a command. By ./ no folder of CDPATH is meant.
PREAMBLE = {
    "bash": f"""_pacesetter_runs() {{
  local name
  (cd ./{RUNS} 2>/dev/null && shopt -s nullglob && for name in */*/[0-9]*; do
    [[ $name == "$1"* ]] && printf "%q\\n" "$name"
  done)
  compgen -f -- "$1" | while IFS= read -r name; do
    [ -d "$name" ] && printf "%q/\\n" "$name" || printf "%q\\n" "$name"
  done
}}""",
    "zsh": f"""_pacesetter_runs() {{
  compadd -- ${{(f)"$(cd ./{RUNS} 2>/dev/null && print -rl -- */*/[0-9]*(N))"}}
  _files
}}""",
}
RUN = {"bash": "_pacesetter_runs", "zsh": "_pacesetter_runs", "tcsh": "f"}


def completion(words: list[str]) -> int:
    """Print the script by which Tab completes in bash, zsh or tcsh."""
    from pacesetter.extras import need

    command = parser("completion", "Print a script for a shell, so that Tab completes pacesetter.")
    command.add_argument("shell", metavar="|".join(SHELLS), help="shell that reads the script")
    command.epilog = 'bash: eval "$(pacesetter completion bash)", such as in ~/.bashrc'
    found = command.parse(words)
    if found.shell not in SHELLS:
        raise unknown("shell", found.shell, SHELLS)
    shtab = need("completion", "shtab", INSTALL)
    print(shtab.complete(_tree(shtab), shell=found.shell, preamble=_preamble()))
    return 0


def _preamble() -> dict[str, str]:
    """The functions that name runs and suites, each with files."""
    from pacesetter.study.bench.suite import shipped

    suites = " ".join(shipped())
    return {
        "bash": f"""{PREAMBLE["bash"]}
_pacesetter_suites() {{ compgen -W "{suites}" -- "$1"; compgen -f -- "$1"; }}""",
        "zsh": f"""{PREAMBLE["zsh"]}
_pacesetter_suites() {{ compadd -- {suites}; _files }}""",
    }


def _tree(shtab: Any) -> ArgumentParser:
    """All verbs under one parser, with what each argument may be."""
    from pacesetter.cli.main import VERBS

    root = ArgumentParser(prog="pacesetter")
    below = root.add_subparsers()
    completed = {
        **dict.fromkeys(("o", "config", "study", "video"), shtab.FILE),
        "runs": shtab.DIRECTORY,
        "run": RUN,
        "start_from": RUN,
        "suite": {"bash": "_pacesetter_suites", "zsh": "_pacesetter_suites", "tcsh": "f"},
    }
    for verb, function in VERBS.items():
        parents = _parents(verb, function)
        for one in parents:
            one.mark("complete", completed)
            one.mark("metavar", {"wrap": "CLASS"})  # zsh would run what follows a colon
        about = (function.__doc__ or "").strip()
        below.add_parser(verb, parents=parents, add_help=False, help=about)
    return root


def _parents(verb: str, function: Callable[[list[str]], int]) -> list[Parser]:
    """What a verb parses its words with, and what these may be."""
    if verb in ("train", "tune"):
        return _training(function)
    if verb == "bench":
        return _bench(function)
    from pacesetter.cli.listing import LISTS
    from pacesetter.media.export import TARGETS

    found = _asked(function, [])
    choices = {"shell": SHELLS, "kind": (*LISTS, "runs"), "to": (*TARGETS,)}
    found.mark("choices", choices)
    return [found]


def _bench(function: Callable[[list[str]], int]) -> list[Parser]:
    """Suite or file, algorithms and envs, then the settings of every algorithm."""
    from pacesetter.envs import known

    first, found = Parser(add_help=False), _asked(function, [])
    first.add_argument("suite", nargs="?")
    found.mark("choices", {"algos": _algorithms(), "envs": known()})
    _add_all_settings(found)
    return [first, found]


def _training(function: Callable[[list[str]], int]) -> list[Parser]:
    """Algorithm and env, then the settings of every algorithm."""
    from pacesetter.envs import known

    first = Parser(add_help=False)
    first.add_argument("algorithm", choices=_algorithms())
    first.add_argument("env", choices=known())
    found = _asked(function, ["td3", "HalfCheetah-v5"])
    _add_all_settings(found)
    return [first, found]


def _algorithms() -> list[str]:
    """What may stand for an algorithm: its name, its ensemble form, a preset."""
    from pacesetter import algorithms
    from pacesetter.config import presets

    return [*algorithms.names(), *algorithms.multi_names(), *presets()]


def _add_all_settings(found: Parser) -> None:
    """A flag for each setting that any algorithm has, with the words that it may be."""
    from pacesetter import algorithms
    from pacesetter.config import Run
    from pacesetter.ensemble.rules import RULES
    from pacesetter.settings.validation import fields_of

    for kind in [Run, *(algorithms.find(name).Hyper for name in algorithms.names())]:
        add_settings(found, "settings", kind, None)
        words = {name: _words(info.annotation) for name, info in fields_of(kind).items()}
        found.mark("choices", {name: one for name, one in words.items() if one})
    found.mark("choices", {"rule": (*RULES,)})


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

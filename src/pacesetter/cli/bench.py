"""The verb `bench`."""

import argparse
import shlex
from typing import Any

from pacesetter.cli.flags import Parser, add_settings, look_here, parser, split_env_kwargs
from pacesetter.cli.streams import aside
from pacesetter.config import Run, preset_layers
from pacesetter.errors import UsageError, tell
from pacesetter.process import cores, exit_code, stopping
from pacesetter.settings import Settings
from pacesetter.study.bench import suite as suites
from pacesetter.study.bench.suite import Suite
from pacesetter.tracking import chosen

OWN = (
    *("algos", "jobs", "executor", "address", "print", "runs", "log", "quiet", "env.KEY"),
    "allow",
)


def bench(words: list[str]) -> int:
    """Train every algorithm on every env with every seed; skip what is done."""
    suite, flags, own = _parse(words)
    chosen(own["log"])
    if own["address"] is not None and own["executor"] != "ray":
        raise UsageError("address: is that of a Ray cluster; add --executor ray")
    always = () if own["log"] is None else (f"--log={own['log']}",)
    jobs = suites.expand(suite, flags, own["runs"], always)
    if own["print"]:
        return _print(suite, jobs, own["print"])
    return _work(jobs, own, words)


def _parse(words: list[str]) -> tuple[Suite, Settings, dict[str, Any]]:
    """The suite, the settings laid over it, and the flags of `bench` itself."""
    name = words[0] if words and not words[0].startswith("-") else None
    command = _parser(name)
    rest, env_kwargs = split_env_kwargs(words[1:] if name else words)
    first, _ = command.parse_known_args([word for word in rest if word not in ("-h", "--help")])
    suite = _suite(name, first.algos) if name or first.algos else None
    if suite is not None:
        named = [*first.allow, *(first.algos or [])]
        look_here(*named)  # their settings are flags, which `parse` needs already
        suite = suite._replace(allow=named)
        suites.require_named(suite, named, vars(first).get("envs", []))
        _add_settings_of(suite, command)
    found = vars(command.parse(rest))
    if suite is None:
        raise UsageError(f"bench: name a suite ({', '.join(suites.shipped())}) or give --algos")
    flags: Settings = {key: value for key, value in found.items() if key not in OWN}
    if env_kwargs:
        flags["env_kwargs"] = env_kwargs
    if len(seeds := flags.get("seeds", [])) == 1:
        flags["seeds"] = seeds[0]
    return suite, flags, {key: found[key] for key in OWN}


def _parser(name: str | None) -> Parser:
    command = parser("bench", "Run a suite, or --algos on --envs. Run it again to continue.")
    if name is not None:
        command.prog = f"pacesetter bench {name}"
    words = "" if name else " [SUITE|FILE.toml]"
    command.usage = f"{command.prog}{words} [--algos ...] [--envs ...] [--SETTING VALUE ...]"
    command.epilog = (
        f"Suites: {', '.join(suites.shipped())}. Every setting of `train` is a flag too; "
        "`bench SUITE --help` lists them."
    )
    add, absent = command.add_argument, argparse.SUPPRESS
    add("--algos", nargs="+", metavar="ALGO", help="algorithms to run, or entries of the suite")
    add("--envs", nargs="+", metavar="ENV", default=absent, help="tasks, for all entries")
    add(
        "--seeds",
        nargs="+",
        type=int,
        metavar="N",
        default=absent,
        help="one number: how many seeds, from 0 on; several numbers: these seeds",
    )
    jobs = "runs at once (default one per core, pinned to it)"
    add("--jobs", type=int, metavar="N", help=jobs)
    executor = "run here or on a Ray cluster (default local)"
    add("--executor", choices=("local", "ray"), default="local", help=executor)
    address = "address of a running Ray cluster, such as auto (default a new one)"
    add("--address", metavar="A", help=address)
    add("--print", choices=("commands", "slurm"), help="print the remaining runs, start none")
    command.add_allow()
    command.add_runs()
    command.add_log()
    command.add_quiet()
    return command


def _suite(name: str | None, algos: list[str] | None) -> Suite:
    if name is None:
        return suites.of_algorithms(algos or [])
    suite = suites.load(name)
    return suites.pick(suite, algos) if algos else suite


def _add_settings_of(suite: Suite, command: Parser) -> None:
    from pacesetter import algorithms

    add_settings(command, "settings of all runs", Run, None, suites.DECIDED)
    names = [entry.get("algorithm", name) for name, entry in suite.entries.items()]
    for base in dict.fromkeys(preset_layers(name, "")[0] for name in names):
        add_settings(command, f"settings of {base}", algorithms.find(base).Hyper, None)
    command.add_env_keywords()


def _print(suite: Suite, jobs: list[suites.Job], form: str) -> int:
    from pacesetter.study.bench.executors import commands, slurm
    from pacesetter.study.bench.queue import Bench

    work = Bench(jobs)
    left = work.left
    for name, why in work.failed.items():
        tell(f"{name}: {why}")
    if left:
        print(slurm(suite.name, left) if form == "slurm" else "\n".join(commands(left)))
    elif not work.failed:
        tell("every run has finished")
    return 1 if work.failed else 0


def _work(jobs: list[suites.Job], own: dict[str, Any], words: list[str]) -> int:
    """Bring all runs to their end, and say how they ended."""
    from pacesetter.cli.bench_progress import display
    from pacesetter.study.bench.queue import Bench

    if own["jobs"] is not None and own["jobs"] < 1:
        raise UsageError(f"jobs: must be at least 1, got {own['jobs']}")
    work = Bench(jobs)
    with aside():
        work.check_envs()
    if not own["quiet"]:
        _warn(work.left)
    executor = _executor(own)
    with (
        stopping(work.stop, lambda: work.kill(executor)) as received,
        display(work, own["quiet"]) as show,
    ):
        for _ in work.run(executor):
            show(work)
    for name, why in work.failed.items():
        tell(f"{name}: {why}")
    print(
        f"{len(work.finished)} of {len(jobs)} runs finished, {work.before} of them before; "
        f"{len(work.failed)} failed"
    )
    if received and len(work.finished) + len(work.failed) < len(jobs):
        print(f"saved; go on with `pacesetter bench {shlex.join(words)}`")
        return exit_code(received)
    return 1 if work.failed else 0


def _warn(jobs: list[suites.Job]) -> None:
    """Say once of each entry and task that its budget ends within the warm-up."""
    from pacesetter.cli.advice import within_warmup

    lines = {(job.config.run.env, job.config.run.name): within_warmup(job.config) for job in jobs}
    for (env, name), line in lines.items():
        if line:
            tell(f"{env} {name}: {line}")


def _executor(own: dict[str, Any]) -> Any:
    from pacesetter.study.bench.executors import Local, Ray

    if own["executor"] == "ray":
        return Ray(own["jobs"], own["address"])
    return Local(own["jobs"] or len(cores()))

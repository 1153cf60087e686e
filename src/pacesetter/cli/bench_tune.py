"""The verbs `bench` and `tune`: parsing and printing only."""

import argparse
import shlex
import sys
from typing import Any

from pacesetter.cli.flags import Parser, add_settings, parser, split_env_kwargs
from pacesetter.config import Run, preset_layers, resolve
from pacesetter.errors import UsageError
from pacesetter.process import cores, exit_code, fix_threads, stopping
from pacesetter.settings import Settings
from pacesetter.study.bench import suite as suites
from pacesetter.study.bench.suite import Suite

OWN = ("algos", "jobs", "executor", "address", "print", "runs", "quiet", "env.KEY")


def bench(words: list[str]) -> int:
    """Run algorithms x envs x seeds: what has finished is skipped, the rest begun or resumed."""
    name = words[0] if words and not words[0].startswith("-") else None
    command = _bench_parser(name)
    rest, env_kwargs = split_env_kwargs(words[1:] if name else words)
    first, _ = command.parse_known_args([word for word in rest if word not in ("-h", "--help")])
    suite = _suite(name, first.algos) if name or first.algos else None
    if suite is not None:
        _add_settings_of(suite, command)
    found = vars(command.parse(rest))
    if suite is None:
        raise UsageError(f"bench: name a suite ({', '.join(suites.shipped())}) or give --algos")
    flags: Settings = {key: value for key, value in found.items() if key not in OWN}
    if env_kwargs:
        flags["env_kwargs"] = env_kwargs
    if len(seeds := flags.get("seeds", [])) == 1:
        flags["seeds"] = seeds[0]
    jobs = suites.expand(suite, flags, found["runs"])
    if found["print"]:
        return _print(suite, jobs, found["print"])
    return _bench(jobs, found, words)


def _bench_parser(name: str | None) -> Parser:
    command = parser("bench [SUITE|FILE.toml]", "Run a suite, or --algos on --envs; call it again.")
    command.epilog = f"suites: {', '.join(suites.shipped())}; every setting of train is a flag too"
    add = command.add_argument
    if name is not None:
        command.prog = f"pacesetter bench {name}"
    absent: Any = argparse.SUPPRESS
    add("--algos", nargs="+", metavar="ALGO", help="algorithms, or entries of the suite")
    add("--envs", nargs="+", metavar="ENV", default=absent, help="tasks, for all entries")
    add("--seeds", nargs="+", type=int, metavar="N", default=absent, help="how many, or which ones")
    add("--jobs", type=int, metavar="N", help="runs at once (default one a core, pinned to it)")
    add("--executor", choices=("local", "ray"), default="local", help="where runs go")
    add("--address", metavar="A", help="of a running Ray cluster, such as auto (default a new one)")
    add("--print", choices=("commands", "slurm"), help="print the runs that are left, run none")
    add("--runs", default="runs", metavar="DIR", help="where runs are (default runs)")
    add("-q", "--quiet", action="store_true", help="no progress")
    return command


def _suite(name: str | None, algos: list[str] | None) -> Suite:
    if name is None:
        return suites.of_algorithms(algos or [])
    suite = suites.load(name)
    return suites.pick(suite, algos) if algos else suite


def _add_settings_of(suite: Suite, command: Parser) -> None:
    from pacesetter import algorithms

    add_settings(command, "all runs", Run, None)
    names = [entry.get("algorithm", name) for name, entry in suite.entries.items()]
    for base in dict.fromkeys(preset_layers(name, "")[0] for name in names):
        add_settings(command, f"settings of {base}", algorithms.find(base).Hyper, None)
    command.add_argument("--env.KEY", metavar="VALUE", help="keyword of the env's constructor")


def _print(suite: Suite, jobs: list[suites.Job], form: str) -> int:
    from pacesetter.study.bench.executors import commands, slurm
    from pacesetter.study.bench.queue import Bench

    left = Bench(jobs).left
    if left:
        print(slurm(suite.name, left) if form == "slurm" else "\n".join(commands(left)))
    else:
        print("pacesetter: every run has finished", file=sys.stderr)
    return 0


def _bench(jobs: list[suites.Job], found: dict[str, Any], words: list[str]) -> int:
    from pacesetter.cli.bench_progress import display
    from pacesetter.study.bench.executors import Local, Ray
    from pacesetter.study.bench.queue import Bench

    if found["jobs"] is not None and found["jobs"] < 1:
        raise UsageError(f"jobs: must be at least 1, got {found['jobs']}")
    work = Bench(jobs)
    work.check_envs()
    if found["executor"] == "ray":
        executor = Ray(found["jobs"], found["address"])
    else:
        executor = Local(found["jobs"] or len(cores()))
    with stopping(work.stop) as received, display(work, found["quiet"]) as show:
        for _ in work.run(executor):
            show(work)
    for name, why in work.failed.items():
        print(f"pacesetter: {name}: {why}", file=sys.stderr)
    print(
        f"{len(work.finished)} of {len(jobs)} runs finished, {work.before} of them before; "
        f"{len(work.failed)} failed"
    )
    if received and len(work.finished) + len(work.failed) < len(jobs):
        print(f"saved; go on with `pacesetter bench {shlex.join(words)}`")
        return exit_code(received)
    return 1 if work.failed else 0


def tune(words: list[str]) -> int:
    """Search the settings of ALGO on ENV that score best, with Optuna."""
    from pacesetter import algorithms

    command = parser("tune ALGO ENV", "Search settings; call it again to go on, or beside it.")
    if len(words) < 2 or words[0].startswith("-") or words[1].startswith("-"):
        command.add_argument("ALGO", help="an algorithm or preset: `pacesetter list algorithms`")
        command.add_argument("ENV", help="a Gymnasium id such as HalfCheetah-v5, or module:Id-v0")
        _add_tune_flags(command)
        command.epilog = "`pacesetter tune ALGO ENV --help` shows the settings that can be fixed"
        command.parse(words)
    algorithm, env = words[:2]
    fix_threads()
    defaults = resolve(algorithm, env).settings() | {"steps": 100_000}
    command.prog = f"pacesetter tune {algorithm} {env}"
    _add_tune_flags(command)
    add_settings(command, "fixed for all trials: the run", Run, defaults)
    hyper = algorithms.find(preset_layers(algorithm, env)[0]).Hyper
    add_settings(command, "fixed for all trials, and not searched, if given", hyper, defaults)
    rest, env_kwargs = split_env_kwargs(words[2:])
    found = vars(command.parse(rest))
    trials, file, quiet = (found.pop(key) for key in ("trials", "study", "quiet"))
    found.pop("env.KEY")
    fixed: Settings = {"steps": 100_000} | found
    if env_kwargs:
        fixed["env_kwargs"] = env_kwargs
    from pacesetter.study.tune.search import Tuning

    tuning = Tuning(algorithm, env, fixed, trials, file)
    with stopping(tuning.stop) as received:
        tuning.run(quiet)
    print(tuning.summary())
    if received and not tuning.over:
        print(f"saved; go on with `pacesetter tune {shlex.join(words)}`")
        return exit_code(received)
    return 0


def _add_tune_flags(command: Parser) -> None:
    command.add_argument("--trials", type=int, default=50, metavar="N", help="in all (default 50)")
    command.add_argument("--study", default="tune.log", metavar="FILE", help="default tune.log")
    command.add_argument("--env.KEY", metavar="VALUE", help="keyword of the env's constructor")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress")

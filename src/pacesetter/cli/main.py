"""The command line: one function a verb, parsing and printing only."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pacesetter.cli.bench_tune import bench, tune
from pacesetter.cli.flags import Parser, add_settings, parser, split_env_kwargs
from pacesetter.errors import TrainingError, UsageError, unknown
from pacesetter.process import exit_code, fix_threads, stopping

if TYPE_CHECKING:
    from pacesetter.training.trainer import Trainer

_OUTPUT_HELP = ".html report, .md or .tex tables, .pdf curves; may be given several times"
NOUNS = ("algorithms", "envs", "rules", "presets", "suites", "runs")


def main(arguments: list[str] | None = None) -> int:
    """Run one command; 0 done, 2 bad input, 130 or 143 saved on a signal, 1 a run that failed."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        if not words or words[0] in ("-h", "--help"):
            print(_overview())
            return 0 if words else 2
        if words[0] == "--version":
            from importlib.metadata import version

            print(version("pacesetter"))
            return 0
        if words[0] not in VERBS:
            raise unknown("verb", words[0], VERBS)
        return VERBS[words[0]](words[1:])
    except UsageError as error:
        print(f"pacesetter: {error}", file=sys.stderr)
        return 2
    except TrainingError as error:
        print(f"pacesetter: stopped: {error}", file=sys.stderr)
        return 1
    except MemoryError as error:
        print(f"pacesetter: stopped: out of memory: {error}; ask for less", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"pacesetter: stopped: {error}", file=sys.stderr)
        return 1


def train(words: list[str]) -> int:
    """Train ALGO on ENV into a new run directory."""
    return _run(_begin, words)


def resume(words: list[str]) -> int:
    """Go on with a run from its last checkpoint."""
    return _run(_take_up, words)


def _begin(words: list[str]) -> tuple["Trainer", bool]:
    """The new run of `train WORDS`, and whether it is to be quiet."""
    from pacesetter import algorithms
    from pacesetter.config import Run, preset_layers, resolve

    command = parser("train ALGO ENV", "Train an algorithm on a task.")
    if len(words) < 2 or words[0].startswith("-") or words[1].startswith("-"):
        command.epilog = "`pacesetter train ALGO ENV --help` shows all its settings; see also list"
        command.add_argument("ALGO", help="an algorithm or preset: `pacesetter list algorithms`")
        command.add_argument("ENV", help="a Gymnasium id such as HalfCheetah-v5, or module:Id-v0")
        if not {"-h", "--help"} & {*words} and any(word.startswith("-") for word in words[:2]):
            raise UsageError("train: ALGO and ENV come first, settings after them")
        command.parse(words)
    algorithm, env, rest = words[0], words[1], words[2:]
    base, _ = preset_layers(algorithm, env)
    fix_threads()
    defaults = resolve(algorithm, env).settings()
    command.prog = f"pacesetter train {algorithm} {env}"
    add_settings(command, "the run", Run, defaults)
    add_settings(command, base, algorithms.find(base).Hyper, defaults)
    command.add_argument("--env.KEY", metavar="VALUE", help="keyword of the env's constructor")
    command.add_argument("--config", metavar="FILE", help="settings as .toml or .json")
    _add_common(command)
    rest, env_kwargs = split_env_kwargs(rest)
    found = vars(command.parse(rest))
    found.pop("env.KEY")
    runs, quiet, config = found.pop("runs"), found.pop("quiet"), found.pop("config")
    if env_kwargs:
        found["env_kwargs"] = env_kwargs
    from pacesetter.training.trainer import Trainer

    return Trainer(algorithm, env, runs=runs, config=config, **found), quiet


def _take_up(words: list[str]) -> tuple["Trainer", bool]:
    """The old run of `resume WORDS`, and whether it is to be quiet."""
    from pacesetter.runs import find

    command = parser("resume", "Go on with a run from its last checkpoint, bit for bit.")
    command.add_argument("run", metavar="RUN", help="its folder, or any tail that is unique")
    command.add_argument("--steps", metavar="N", help="new budget of env steps, such as 2M")
    command.add_argument("--time", metavar="T", help="new budget of time, such as 2h")
    _add_common(command)
    found = command.parse(words)
    directory = find(found.run, found.runs)
    fix_threads(directory.record().get("threads"))
    from pacesetter.training.trainer import Trainer

    trainer = Trainer.resume(directory.path, steps=found.steps, time=found.time)
    for note in trainer.notes:
        print(f"pacesetter: {note}", file=sys.stderr)
    return trainer, found.quiet


def evaluate(words: list[str]) -> int:
    """Score a policy on fresh episodes."""
    import numpy as np

    from pacesetter.evaluation import evaluate
    from pacesetter.policy import load
    from pacesetter.runs import find

    command = parser("eval", "Score a run's champion, or a policy file, on fresh episodes.")
    command.add_argument("run", metavar="RUN|FILE", help="a run, or a policy.safetensors")
    command.add_argument("--episodes", type=int, default=100, metavar="N", help="default 100")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="of the starts")
    command.add_argument("--noise", type=float, default=0.0, metavar="X", help="on actions")
    command.add_argument("--env", metavar="ID", help="the task, if not the one in the file")
    command.add_argument("--env.KEY", metavar="VALUE", help="keyword of the env's constructor")
    command.add_argument("--random", action="store_true", help="uniform actions, not the policy")
    command.add_argument("--json", action="store_true", help="print all returns as JSON")
    command.add_argument("--runs", default="runs", metavar="DIR", help="default runs")
    words, env_kwargs = split_env_kwargs(words)
    found = command.parse(words)
    path, env = Path(found.run), found.env
    if path.suffix != ".safetensors":
        run = find(found.run, found.runs)
        path, env = run.policy_file, env or run.settings()["env"]
    policy = load(path)
    task = env or policy.about.get("env")
    if task == policy.about.get("env"):
        env_kwargs = policy.about.get("env_kwargs", {}) | env_kwargs
    how: Any = {"noise": found.noise, "env_kwargs": env_kwargs, "random": found.random}
    result = evaluate(policy, env, found.episodes, found.seed, **how)
    about = {"env": task, "env_kwargs": env_kwargs, "seed": found.seed, "noise": found.noise}
    source = None if found.random else str(path)
    if found.json:
        print(json.dumps({**result.table(), **about, "policy": source}))
    else:
        who = (
            "uniform actions" if found.random else f"policy of step {policy.about.get('step', 0):,}"
        )
        print(
            f"{task}: return {result.mean:.1f} +- {result.std:.1f} over {found.episodes} "
            f"episodes of {np.mean(result.lengths):.0f} steps; {who}"
        )
    return 0


def list_(words: list[str]) -> int:
    """List what there is of a noun."""
    command = parser("list", "List algorithms, envs, rules, presets, suites or runs.")
    command.add_argument("noun", metavar="|".join(NOUNS))
    command.add_argument("--runs", default="runs", metavar="DIR", help="default runs")
    found = command.parse(words)
    if found.noun not in NOUNS:
        raise unknown("list", found.noun, NOUNS)
    from pacesetter.cli import listing

    for line in getattr(listing, found.noun)(*([found.runs] if found.noun == "runs" else [])):
        print(line)
    return 0


def show(words: list[str]) -> int:
    """Show one run."""
    from pacesetter.cli import listing
    from pacesetter.runs import find

    command = parser("show", "Show a run: its settings, what it spent and how it did.")
    command.add_argument("run", metavar="RUN", help="its folder, or any tail that is unique")
    command.add_argument("--runs", default="runs", metavar="DIR", help="default runs")
    found = command.parse(words)
    for line in listing.describe(find(found.run, found.runs)):
        print(line)
    return 0


def compare(words: list[str]) -> int:
    """Compare runs: statistics, tables, curves, a report."""
    command = parser("compare", "Compare runs, grouped by env and name: tables, curves, a report.")
    command.add_argument(
        "run",
        nargs="+",
        metavar="RUN",
        help="folders, tails or patterns of runs, or .jsonl results",
    )
    command.add_argument("--metric", default="final", metavar="X", help="final, auc or max")
    command.add_argument("--budget", metavar="N", help="count every run up to N env steps only")
    command.add_argument("--cpu", metavar="T", help="count every run up to that CPU time, as 10m")
    command.add_argument("--reference", default="td3", metavar="NAME", help="control; default td3")
    command.add_argument("--published", action="store_true", help="add published returns")
    command.add_argument("--mixed", action="store_true", help="allow unlike versions and budgets")
    command.add_argument("--smooth", type=int, metavar="N", help="smooth curves over N evaluations")
    command.add_argument("--no-film", action="store_true", help="no video in the report")
    command.add_argument("-o", action="append", default=[], metavar="FILE", help=_OUTPUT_HELP)
    command.add_argument("--runs", default="runs", metavar="DIR", help="default runs")
    found = command.parse(words)
    from pacesetter.study.compare.comparison import compare
    from pacesetter.study.report import output

    options = output.Options(found.published, found.smooth, not found.no_film)
    paths = output.check(found.o, options)
    comparison = compare(
        found.run,
        below=found.runs,
        metric=found.metric,
        budget=found.budget,
        cpu=found.cpu,
        reference=found.reference,
        mixed=found.mixed,
    )
    for path in paths:
        output.write(comparison, path, options)
        print(path)
    if not paths:
        print(output.text(comparison, options))
    return 0


VERBS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "resume": resume,
    "eval": evaluate,
    "list": list_,
    "show": show,
    "compare": compare,
    "bench": bench,
    "tune": tune,
}


def _overview() -> str:
    lines = [f"  {verb:8}{(function.__doc__ or '').strip()}" for verb, function in VERBS.items()]
    return "\n".join(
        [
            "usage: pacesetter VERB ...",
            "",
            "Train ensembles of agents that learn to walk, and prove what the ensemble is worth.",
            "",
            *lines,
            "",
            "Start with `pacesetter train multi-td3 HalfCheetah-v5`; `VERB --help` tells more.",
        ]
    )


def _add_common(command: Parser) -> None:
    command.add_argument("--runs", default="runs", metavar="DIR", help="where runs are")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress")


def _run(begin: Callable[[list[str]], tuple["Trainer", bool]], words: list[str]) -> int:
    from pacesetter.cli.progress import console

    final: Any = None
    trainers: list[Trainer] = []
    # From before JAX is imported, which dies of an exception of ours or swallows it.
    with stopping(lambda: [each.stop() for each in trainers]) as received:
        trainer, quiet = begin(words)
        trainers.append(trainer)
        if received:
            trainer.stop()
        with console(trainer, quiet) as sink:
            for report in trainer:
                sink(report)
                final = report if report.kind == "eval" else final
    run, step = trainer.config.run, trainer.progress.step
    result = f", return {final.values['mean']:.1f} at step {final.step:,}" if final else ""
    print(f"{run.env} {run.name} seed {run.seed}: {step:,} steps{result}")
    if received and not trainer.finished:
        print(f"saved; go on with `pacesetter resume {trainer.directory.path}`")
        return exit_code(received)
    print(f"policy: {trainer.directory.policy_file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

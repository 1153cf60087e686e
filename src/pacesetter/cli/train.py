"""The verbs `train` and `resume`."""

import shlex
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

from pacesetter import consent
from pacesetter.cli.flags import RUNS, add_settings, algorithm_and_env, parser, split_env_kwargs
from pacesetter.cli.streams import aside
from pacesetter.errors import tell
from pacesetter.process import exit_code, fix_threads, stopping
from pacesetter.settings import Settings
from pacesetter.settings.validation import fields_of
from pacesetter.tracking import chosen, tracked

if TYPE_CHECKING:
    from pacesetter.training.trainer import Trainer


SPENT = (
    "budget: nothing is left to do; to go on, give more --steps, or a new --time, --stop-at or "
    "--stop-patience"
)


class Command(NamedTuple):
    """A run to train, and the command's own flags: no progress, and trackers of the log."""

    trainer: "Trainer"
    quiet: bool
    log: list[str] | None


def train(words: list[str]) -> int:
    """Train ALGO on ENV in a new run folder."""
    return _run(_new_trainer, words)


def resume(words: list[str]) -> int:
    """Continue a run from its last checkpoint."""
    return _run(_resumed_trainer, words)


def _new_trainer(words: list[str]) -> Command:
    """The new run of `train WORDS`."""
    command = parser("train", "Train an algorithm on a task.")
    algorithm, env, rest = algorithm_and_env(command, words)
    fix_threads()
    _add_settings(command, algorithm, env)
    rest, env_kwargs = split_env_kwargs(rest)
    settings = vars(command.parse(rest))
    settings.pop("env.KEY")
    runs, quiet, config = (settings.pop(key) for key in ("runs", "quiet", "config"))
    log = chosen(settings.pop("log"))
    if env_kwargs:
        settings["env_kwargs"] = env_kwargs
    from pacesetter.training.trainer import Trainer

    with aside():
        return Command(Trainer(algorithm, env, runs=runs, config=config, **settings), quiet, log)


def _add_settings(command: Any, algorithm: str, env: str) -> None:
    """All flags of `train ALGO ENV`, with the defaults of that algorithm on that task."""
    from pacesetter import algorithms
    from pacesetter.config import Run, preset_layers, resolve
    from pacesetter.settings import OnPolicy
    from pacesetter.settings.ensemble import Ensemble

    base, _ = preset_layers(algorithm, env)
    hyper = algorithms.find(base).Hyper
    defaults: Settings = resolve(algorithm, env).settings()
    command.prog = f"pacesetter train {algorithm} {env}"
    command.usage = f"{command.prog} [--SETTING VALUE ...]"
    command.add_env_keywords()
    command.add_argument("--config", metavar="FILE", help="read settings from a .toml or .json")
    command.add_runs()
    command.add_log()
    command.add_quiet()
    hidden = fields_of(Ensemble) if issubclass(hyper, OnPolicy) else ()
    add_settings(command, "settings of the run", Run, defaults, hidden)
    add_settings(command, f"settings of {base}", hyper, defaults)


def _resumed_trainer(words: list[str]) -> Command:
    """The old run of `resume WORDS`."""
    from pacesetter.config import Run
    from pacesetter.runs import find

    command = parser(
        "resume", "Continue a run from its last checkpoint, exactly as if it had never stopped."
    )
    command.add_argument("run", metavar="RUN", help="run folder, or the end of its path")
    add = command.add_argument
    add("--steps", metavar="N", help="new budget of env steps, such as 2M")
    add("--time", metavar="T", help="new limit of wall time, such as 2h")
    add("--stop-at", type=float, metavar="RETURN", help="new mean return to stop at")
    patience = "new number of evaluations without a best one, after which to stop"
    add("--stop-patience", type=int, metavar="N", help=patience)
    limit = "new limit of a task's step, reset or making, such as 30s"
    add("--env-timeout", metavar="T", help=limit)
    add("--checkpoint-every", metavar="T", help="new time between checkpoints, such as 5m")
    devices = get_args(fields_of(Run)["device"].annotation)
    add("--device", choices=devices, help="new device to learn on")
    command.add_allow()
    command.add_runs()
    command.add_log()
    command.add_quiet()
    found = command.parse(words)
    log = chosen(found.log)
    directory = find(found.run, found.runs)
    fix_threads(directory.record().get("threads"))
    from pacesetter.training.trainer import Trainer

    budgets = ("steps", "time", "stop_at", "stop_patience")
    names = (*budgets, "env_timeout", "checkpoint_every", "device", "allow")
    given = {name: getattr(found, name) for name in names}
    with aside():
        trainer = Trainer.resume(directory.path, runs=found.runs, **given)
    return Command(trainer, found.quiet, log)


def name_of(path: Path) -> str:
    """What a person may type for a run: without the folder where runs are looked for anyway."""
    return str(path.relative_to(RUNS)) if path.is_relative_to(RUNS) else str(path)


def _run(begin: Callable[[list[str]], Command], words: list[str]) -> int:
    """Train to the end or to a signal, and say where the result is."""
    from pacesetter.cli.advice import within_warmup
    from pacesetter.cli.progress import console

    final: Any = None
    trainers: list[Trainer] = []
    # From before JAX is imported, which dies of an exception of ours or swallows it.
    with stopping(lambda: [each.stop() for each in trainers]) as received:
        trainer, quiet, log = begin(words)
        trainers.append(trainer)
        for note in (*trainer.notes, *([SPENT] if trainer.finished else ())):
            tell(note)
        if received:
            trainer.stop()
        if not quiet and (line := within_warmup(trainer.config)):
            tell(line)
        with (
            aside(),
            closing(trainer),
            tracked(trainer.directory, log) as write,
            console(trainer, quiet) as show,
        ):
            for report in trainer:
                write(report.row())
                show(report)
                final = report if report.kind == "eval" else final
    run, step = trainer.config.run, trainer.progress.step
    result = f", return {final.values['mean']:.1f} at step {final.step:,}" if final else ""
    print(f"{run.env} {run.name} seed {run.seed}: {step:,} steps{result}")
    if received and not trainer.finished:
        words = trainer.directory.resume_words(trainer.config)
        print(f"saved; go on with `pacesetter {shlex.join(words)}`")
        return exit_code(received)
    called = name_of(trainer.directory.path)
    print(f"policy: {trainer.directory.policy_file}")
    print(f"run: {called}, a name for show, eval, record, resume and compare")
    film = ["record", called, "-o", "walk.mp4", *consent.words(run.env, *run.wrap)]
    print(f"film it: `pacesetter {shlex.join(film)}`")
    return 0

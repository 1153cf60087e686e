"""The verb `tune`."""

import shlex
from typing import Any

from pacesetter.cli.flags import Parser, add_settings, algorithm_and_env, parser, split_env_kwargs
from pacesetter.cli.streams import aside
from pacesetter.errors import tell
from pacesetter.process import exit_code, fix_threads, stopping
from pacesetter.settings import Settings

STEPS = 100_000  # of a trial


def tune(words: list[str]) -> int:
    """Search the settings of ALGO on ENV that score best, with Optuna."""
    algorithm, env, fixed, own = _parse(words)
    from pacesetter.cli.advice import within_warmup
    from pacesetter.cli.progress import console
    from pacesetter.study.tune.search import Tuning

    tuning = Tuning(algorithm, env, fixed, own["trials"], own["study"])
    if (
        not own["quiet"]
        and "warmup" not in tuning.ranges
        and (line := within_warmup(tuning.config))
    ):
        tell(line)
    with aside(), stopping(tuning.stop) as received:
        tuning.run(lambda trainer: console(trainer, own["quiet"]))
    print(tuning.summary())
    if received and not tuning.over:
        print(f"saved; go on with `pacesetter tune {shlex.join(words)}`")
        return exit_code(received)
    return 1 if tuning.over and not tuning.any_complete else 0


def _parse(words: list[str]) -> tuple[str, str, Settings, dict[str, Any]]:
    """Algorithm, env, the settings that are fixed, and the flags of `tune` itself."""
    command = parser(
        "tune",
        "Search settings. Run it again to continue, or several times at once to share the work.",
    )
    _add_own_flags(command)
    algorithm, env, rest = algorithm_and_env(command, words)
    fix_threads()
    _add_settings(command, algorithm, env)
    rest, env_kwargs = split_env_kwargs(rest)
    found = vars(command.parse(rest))
    own = {key: found.pop(key) for key in ("trials", "study", "quiet", "env.KEY")}
    fixed: Settings = {"steps": STEPS} | found
    if env_kwargs:
        fixed["env_kwargs"] = env_kwargs
    return algorithm, env, fixed, own


def _add_own_flags(command: Parser) -> None:
    add = command.add_argument
    add("--trials", type=int, default=50, metavar="N", help="trials in all (default 50)")
    study = "file that workers share (default tune.log)"
    add("--study", default="tune.log", metavar="FILE", help=study)
    command.add_env_keywords()
    command.add_quiet()


def _add_settings(command: Parser, algorithm: str, env: str) -> None:
    """The settings that can be fixed, with the defaults of that algorithm on that task."""
    from pacesetter import algorithms
    from pacesetter.config import Run, preset_layers, resolve

    command.prog = f"pacesetter tune {algorithm} {env}"
    command.usage = f"{command.prog} [--SETTING VALUE ...]"
    defaults = resolve(algorithm, env).settings() | {"steps": STEPS}
    add_settings(command, "settings of every trial's run", Run, defaults)
    hyper = algorithms.find(preset_layers(algorithm, env)[0]).Hyper
    title = "settings of the algorithm; what is given here is fixed, not searched"
    add_settings(command, title, hyper, defaults)

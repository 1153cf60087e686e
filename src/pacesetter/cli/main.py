"""The command line: find the verb, call it, and turn what goes wrong into one line and a code."""

import sys
from collections.abc import Callable
from signal import SIGINT

from pacesetter.cli.bench import bench
from pacesetter.cli.compare import compare
from pacesetter.cli.completion import completion
from pacesetter.cli.evaluate import evaluate
from pacesetter.cli.listing import list_
from pacesetter.cli.live import live
from pacesetter.cli.pictures import poster, record, watch
from pacesetter.cli.share import export, fetch, push
from pacesetter.cli.show import show
from pacesetter.cli.train import resume, train
from pacesetter.cli.tune import tune
from pacesetter.errors import TrainingError, UsageError, tell, unknown
from pacesetter.process import Interrupted, exit_code, forget_jax_settings

VERBS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "resume": resume,
    "eval": evaluate,
    "list": list_,
    "show": show,
    "live": live,
    "compare": compare,
    "bench": bench,
    "tune": tune,
    "record": record,
    "poster": poster,
    "watch": watch,
    "export": export,
    "push": push,
    "fetch": fetch,
    "completion": completion,
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Returns its exit code.

    0: done. 1: a run failed. 2: bad input. 75: the run is in use. 129, 130 or 143: a signal.
    """
    try:
        return _run(sys.argv[1:] if arguments is None else arguments)
    except UsageError as error:
        tell(str(error))
        return error.code
    except TrainingError as error:
        tell(f"stopped: {error}")
        return error.code
    except MemoryError as error:
        less = "ask for less, such as fewer members or a smaller batch"
        tell(f"stopped: out of memory: {error}; {less}")
        return 1
    except Interrupted as signal:
        return exit_code([*signal.args])
    except KeyboardInterrupt:
        return exit_code([SIGINT])
    except OSError as error:
        tell(f"stopped: {error}")
        return 1


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0 if words else 2
    if words[0] == "--version":
        from importlib.metadata import version

        print(version("pacesetter"))
        return 0
    if words[0] not in VERBS:
        raise unknown("verb", words[0], VERBS, see="pacesetter --help")
    if ignored := forget_jax_settings():
        why = "the numbers of a seed may depend on what JAX is told there"
        tell(f"ignored {', '.join(ignored)}: {why}")
    return VERBS[words[0]](words[1:])


def _overview() -> str:
    lines = [f"  {verb:10} {(function.__doc__ or '').strip()}" for verb, function in VERBS.items()]
    return "\n".join(
        [
            "usage: pacesetter VERB ...",
            "",
            "Train ensembles of agents that learn to walk, and prove what the ensemble is worth.",
            "",
            *lines,
            "",
            "Start with `pacesetter train crossq-small HalfCheetah-v5 --steps 100k`.",
            "`pacesetter VERB --help` tells more about a verb.",
        ]
    )

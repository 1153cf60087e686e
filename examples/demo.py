"""Train a walker for five minutes, or go on with it; print a table, draw a curve and a film.

All is written below the working directory: runs/, demo.png and demo.mp4.
"""

import sys
from pathlib import Path

from tabulate import tabulate

from pacesetter import Trainer, load
from pacesetter.cli.progress import console
from pacesetter.errors import TrainingError, UsageError
from pacesetter.evaluation import evaluate
from pacesetter.media.curve import curve
from pacesetter.media.record import record
from pacesetter.policy import Policy
from pacesetter.process import multiplies_bfloat16, stopping
from pacesetter.runs import RunDirectory

# Without such instructions products of bfloat16 are slower than those of float32.
PRECISION = "bf16" if multiplies_bfloat16() else "f32"
ENV, RUNS = "HalfCheetah-v5", Path("runs")
NAME = "demo"  # so that no later `pacesetter train` finds its folder taken
RUN = RUNS / ENV / NAME / "0"
EPISODES, SEED = 10, 1


def main() -> int:
    """0 when all is done, 130 when Ctrl-C came first, 2 and 1 as the command line has them."""
    try:
        trainer = open_run()
        if not train(trainer):
            say("stopped and saved; run it again to go on from here")
            return 130
        policy = load(trainer.directory.policy_file)
        print(table(trainer.directory, policy))
        draw(trainer.directory, policy)
    except UsageError as error:
        say(str(error))
        return 2
    except TrainingError as error:
        say(f"stopped: {error}")
        return 1
    except KeyboardInterrupt:
        say("stopped; run it again to go on from the last checkpoint")
        return 130
    return 0


def open_run() -> Trainer:
    """A new run, or the one that an earlier call began."""
    if not RunDirectory(RUN).config_file.exists():
        say(f"training into {RUN} for at most 5 minutes; Ctrl-C saves, and a new call goes on")
        settings = {"steps": 150_000, "time": "5m", "precision": PRECISION}
        return Trainer("td7-small", ENV, name=NAME, runs=RUNS, **settings)
    trainer = Trainer.resume(RUN, runs=RUNS)
    for note in trainer.notes:
        say(note)
    word = "finished at" if trainer.finished else "going on from"
    say(f"{RUN}: {word} step {trainer.progress.step:,}")
    return trainer


def train(trainer: Trainer) -> bool:
    """Spend what is left of the budget; False if Ctrl-C ended it early, with all saved."""
    if trainer.finished:
        trainer.close()
        return True
    with stopping(trainer.stop), console(trainer) as show:
        for report in trainer:
            show(report)
    return trainer.finished


def table(run: RunDirectory, policy: Policy) -> str:
    """What training was worth, on starts that it never saw."""
    random = evaluate(None, ENV, EPISODES, SEED)
    trained = evaluate(policy, ENV, EPISODES, SEED)
    untrained = next(row for row in run.rows() if row["kind"] == "eval" and row["step"] == 0)
    step = policy.about["step"]
    rows = [
        ("random actions", random.mean, random.std, EPISODES),
        ("untrained policy", untrained["mean"], untrained["std"], len(untrained["returns"])),
        (f"champion at step {step:,}", trained.mean, trained.std, EPISODES),
    ]
    headers = (ENV, "mean return", "std over episodes", "episodes")
    return tabulate(rows, headers, floatfmt=",.1f")


def draw(run: RunDirectory, policy: Policy) -> None:
    """Curve and film; a machine without OpenGL gets the curve and one line about the film."""
    curve(run, "demo.png")
    say("demo.png: the learning curve")
    try:
        record(policy, "demo.mp4", frames=200, size=(640, 480), seed=SEED)
    except UsageError as error:
        say(str(error))
    else:
        say("demo.mp4: the champion for 200 steps")


def say(line: str) -> None:
    """Tell on stderr, so that stdout holds the table alone."""
    print(f"demo: {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

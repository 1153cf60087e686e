"""Experiment: every kind of file that is read, with one odd thing in it."""

import random
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import mutations
from attempts import FINE, Tally, attempt, command, patched, trap
from short_runs import TINY, run_to_end

from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory
from pacesetter.storage import as_json
from pacesetter.study.compare.results import compact
from pacesetter.study.tune.search import Tuning
from pacesetter.training import checkpoint, trainer
from pacesetter.training.trainer import Trainer

KINDS = (
    *("config.json", "metrics.jsonl", "policy.safetensors", "state.safetensors"),
    *("settings.toml", "suite.toml", "results.jsonl", "study.log"),
)
PROBE = "broken_envs:Probe-v0"
SETTINGS = """\
gamma = 0.98
hidden = [8, 8]
steps = "5k"
replay = "prioritized"
seed = 3
env_kwargs = {gain = 2.0}
"""
SUITE = """\
help = "a suite"
steps = "5k"
envs = ["Pendulum-v1"]
seeds = [1, 2]
[entries.td3]
gamma = 0.9
[entries.mine]
algorithm = "multi-td3"
members = 3
[entries.mine.env."Pendulum-*"]
steps = "1k"
"""


class Base:
    """A finished run and what belongs to it, of which copies are spoiled."""

    def __init__(self, folder: Path) -> None:
        settings: dict[str, Any] = TINY | {"steps": 260, "hidden": (4,), "eval_every": 100}
        made = run_to_end(Trainer("multi-td3", PROBE, runs=folder / "made", **settings))
        self.folder = folder
        self.held: Trainer | None = None
        self.made = made
        self.run = RunDirectory(folder / "runs" / made.path.name)
        shutil.copytree(made.path, self.run.path)
        self.files: dict[str, bytes] = {
            "settings.toml": SETTINGS.encode(),
            "suite.toml": SUITE.encode(),
            "results.jsonl": _results(made),
            "study.log": _made_study(folder),
        }
        for name, data in self.files.items():
            (folder / name).write_bytes(data)

    def close(self) -> None:
        """Let go of the trainer that takes up checkpoints."""
        if self.held is not None:
            self.held.close()

    def bytes_of(self, path: Path) -> bytes:
        """The whole content of a file of the run or beside it."""
        inside = path.is_relative_to(self.run.path)
        whole = self.made.path / path.relative_to(self.run.path) if inside else path
        return whole.read_bytes() if inside else self.files[path.name]


def _results(made: RunDirectory) -> bytes:
    """The run as two lines of results, as if of two seeds."""
    row = compact(made)
    rows = [row | {"settings": row["settings"] | {"seed": seed}} for seed in (0, 1)]
    return "".join(as_json(each) + "\n" for each in rows).encode()


Case = tuple[Path, Callable[[bytes, random.Random], bytes], list[Callable[[], None]]]


def cases(base: Base) -> dict[str, Case]:
    """Each kind of file: where it lies, how it is made odd, and what then reads it."""
    run, folder = base.run, base.folder
    runs = folder / "runs"
    settings, suite = folder / "settings.toml", folder / "suite.toml"
    results, page = folder / "results.jsonl", folder / "page"
    compares = [command("compare", results, *more) for more in _outputs(page)]
    return {
        "config.json": (
            run.config_file,
            mutations.json_file,
            [
                *(command(*words, "--runs", runs) for words in (["list", "runs"],)),
                command("show", run.path),
                command("compare", run.path),
                command("eval", run.path, "--episodes", 1),
                command("resume", run.path, "-q"),
            ],
        ),
        "metrics.jsonl": (
            run.metrics_file,
            mutations.json_lines,
            [
                command("list", "runs", "--runs", runs),
                command("show", run.path),
                *(command("compare", run.path, *more) for more in _outputs(page)),
            ],
        ),
        "policy.safetensors": (
            run.policy_file,
            mutations.tensors,
            [
                command("eval", run.policy_file, "--episodes", 1),
                command("show", run.policy_file),
            ],
        ),
        "settings.toml": (
            settings,
            mutations.toml_file,
            [command("train", "td3", PROBE, "--config", settings, "--runs", folder / "new")],
        ),
        "suite.toml": (
            suite,
            mutations.toml_file,
            [command("bench", suite, "--print", "commands", "--runs", folder / "new")],
        ),
        "results.jsonl": (results, mutations.json_lines, compares),
        "study.log": (folder / "study.log", mutations.json_lines, [_tuning(folder)]),
        "state.safetensors": (run.state_file, mutations.tensors, [_restoring(base)]),
    }


def _outputs(page: Path) -> Iterator[list[object]]:
    yield []
    for suffix in (".md", ".tex", ".html"):
        yield ["-o", page.with_suffix(suffix), "--no-film"]


def _restoring(base: Base) -> Callable[[], None]:
    """Take up a checkpoint, train on for two ticks, and save."""
    shutil.copytree(base.made.path, path := base.folder / "held")
    held = Trainer.resume(path, steps=10_000)
    base.held = held

    def act() -> None:
        base.run.previous_file.unlink(missing_ok=True)
        checkpoint.restore(held.loop, held.config, base.run)
        for _ in range(2):
            held.loop.tick()
        checkpoint.save(held.loop, held.config, held.directory)

    return act


def _tuning(folder: Path) -> Callable[[], None]:
    """Open a study, take one trial of it, and say how it stands."""
    study = ["--study", folder / "study.log", "--steps", 100, "--trials", 3]
    return command("tune", "td3", PROBE, *study, "--hidden", 4, "--eval-every", 50)


def _made_study(folder: Path) -> bytes:
    """The journal of two short trials."""
    _tuning(folder)()
    return (folder / "study.log").read_bytes()


def no_further(device: str) -> None:
    raise UsageError(FINE)


def run(folder: Path, kinds: Iterable[str], each: int, seed: int = 0) -> Tally:
    """So many odd files of each kind."""
    rng = random.Random(seed)
    base = Base(folder)
    found = cases(base)
    # What is imported once is not the time of an attempt.
    command("compare", base.run.path, "-o", folder / "page.html", "--no-film")()
    with ExitStack() as stack:
        stack.callback(base.close)
        stack.enter_context(trap(folder))
        stack.enter_context(patched(Trainer, "__iter__", lambda self: iter(())))
        stack.enter_context(patched(Tuning, "_try", lambda self, *trial: self.stop()))
        tally = Tally()
        for kind in kinds:
            path, spoil, readers = found[kind]
            no_training = kind == "settings.toml"
            fake = no_further if no_training else trainer.prepare
            with patched(trainer, "prepare", fake):
                for number in range(each):
                    path.write_bytes(spoil(base.bytes_of(path), rng))
                    reader = readers[number % len(readers)]
                    attempt(tally, f"{kind} {number}", reader)
                path.write_bytes(base.bytes_of(path))
    return tally

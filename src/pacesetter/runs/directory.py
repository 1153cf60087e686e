"""The run directory: its files, its config, its log and its lock."""

import fcntl
import json
import os
import platform
import re
import shlex
import shutil
from collections.abc import Iterable
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from pacesetter.config import Config, resolve
from pacesetter.consent import require, words
from pacesetter.errors import InUseError, UsageError
from pacesetter.runs.provenance import provenance
from pacesetter.settings.validation import difference
from pacesetter.storage import TEMPORARY, as_json, write_atomically

SCHEMA = 1
# Settings in which the seeds of one name may differ.
FREE_PER_SEED = {
    "seed",
    "steps",
    "time",
    "replay_horizon",
    "lr_horizon",
    "checkpoint_every",
    "device",
}
Row = dict[str, Any]


class RunDirectory:
    """One run's folder, held by at most one process at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / "config.json"
        self.metrics_file = path / "metrics.jsonl"
        self.policy_file = path / "policy.safetensors"
        self.best_file = path / "best.safetensors"
        self.state_file = path / "last" / "state.safetensors"
        self.previous_file = path / "last" / "previous.safetensors"
        self._lock: TextIOWrapper | None = None
        self._made: list[Path] = []  # folders that `create` made, the innermost first

    @classmethod
    def of(cls, runs: str | Path, config: Config) -> "RunDirectory":
        """Where a run's settings place it: runs / env / name / seed."""
        run = config.run
        return cls(Path(runs) / re.sub(r"[/:]", "-", run.env) / run.name / str(run.seed))

    def refuse_existing(self, config: Config) -> None:
        """Refuse to train where a run is already, and say what to do instead."""
        if not self.config_file.exists():
            self._refuse_other_seeds(config)
            return
        resume = f"go on with `pacesetter {shlex.join(self.resume_words(config))}`"
        if found := self.difference_from(config):
            raise UsageError(
                f"run: {self.path} exists with {found}; give this one another --name, or {resume}"
            )
        raise UsageError(f"run: {self.path} exists; {resume}")

    def resume_words(self, config: Config) -> list[str]:
        """The command that goes on with this run, with consent to what the run itself names."""
        return ["resume", str(self.path), *words(config.run.algorithm, config.run.env)]

    def difference_from(self, config: Config) -> str | None:
        """The first setting in which the run here differs; None if none does, or no run is here."""
        if not self.config_file.exists():
            return None
        old, new, own = self.settings(), config.settings(), ("algorithm", "env")
        if found := difference(old, new, own):  # a name of the file's own is not even looked up
            return found
        return difference(self.config([new[name] for name in own]).settings(), new, new)

    def _refuse_other_seeds(self, config: Config) -> None:
        """Refuse a new seed whose settings differ from those of the other seeds of its name."""
        new = json.loads(json.dumps(config.settings()))
        for file in sorted(self.path.parent.glob("*/config.json")):
            try:
                old = RunDirectory(file.parent).settings()
            except UsageError:  # damaged, which is for its own commands to say
                continue
            # A setting that an older version did not have is not a difference.
            shared = [key for key in new if key in old and key not in FREE_PER_SEED]
            if found := difference(old, new, shared):
                raise UsageError(
                    f"run: {file.parent} has {found}; give runs with other settings another --name"
                )

    def create(self, config: Config, **found: Any) -> None:
        """Make the folder and write its config, which starts the run on disk."""
        try:
            places = (self.path, *self.path.parents)
            self._made = [folder for folder in places if not folder.exists()]
            self.state_file.parent.mkdir(parents=True, exist_ok=True)
            self.lock()
            self.refuse_existing(config)  # another process may have been quicker
            table = {"schema": SCHEMA, "settings": config.settings(), **provenance(**found)}
            self._write_config(table)
        except OSError as error:
            raise UsageError(f"runs: cannot write {self.path}: {error.strerror}") from None

    def note_resume(self, config: Config, step: int, **found: Any) -> None:
        """Note in the config when and with what the run was resumed, and its settings now."""
        table = self.record()
        resumed = [*table.get("resumed", []), {"step": step, **provenance(**found)}]
        self._write_config(table | {"settings": config.settings(), "resumed": resumed})

    def remove(self) -> None:
        """Undo `create` for a run that cannot start."""
        self.unlock()
        shutil.rmtree(self.path)
        for folder in self._made[1:]:
            if any(folder.iterdir()):
                break
            folder.rmdir()

    def _write_config(self, table: Row) -> None:
        write_atomically(self.config_file, (as_json(table, indent=1) + "\n").encode())

    def record(self) -> Row:
        """The whole config.json."""
        try:
            table = json.loads(self.config_file.read_text())
            if table["schema"] != SCHEMA:
                raise ValueError(f"schema {table['schema']}, this version reads {SCHEMA}")
            if not isinstance(table.get("threads"), int):
                raise ValueError("threads must be a whole number")
            if not all(isinstance(table["settings"][key], str) for key in ("algorithm", "env")):
                raise ValueError("algorithm and env must be words")
        except FileNotFoundError:
            raise UsageError(f"run: {self.path} holds no run (no config.json)") from None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise UsageError(f"{self.config_file}: damaged or foreign: {error}") from None
        return table

    def settings(self) -> Row:
        """The run's flat settings."""
        return self.record()["settings"]

    def config(self, allow: Iterable[str] = ()) -> Config:
        """The run's checked settings; `allow` are names that may import a module."""
        settings = self.settings()
        for name in ("algorithm", "env"):
            require(name, settings[name], allow)
        try:
            return resolve(settings["algorithm"], settings["env"], settings)
        except KeyError as error:
            raise UsageError(f"{self.config_file}: damaged: {error} is missing") from None

    def rows(self, *kinds: str) -> list[Row]:
        """All complete rows of the log, or only those of some kinds; others are not parsed."""
        if not self.metrics_file.exists():
            return []
        starts = tuple(f'{{"kind": "{kind}"' for kind in kinds) or ""
        try:
            lines = self.metrics_file.read_text().split("\n")[:-1]
            found = [json.loads(line) for line in lines if line.startswith(starts)]
            if not all(isinstance(row, dict) for row in found):
                raise ValueError("a line is not a table")
        except ValueError as error:
            raise UsageError(f"{self.metrics_file}: damaged: {error}") from None
        return found

    def append(self, row: Row) -> None:
        """Add one line to the log."""
        with self.metrics_file.open("a") as file:
            file.write(as_json(row) + "\n")

    def log_size(self) -> int:
        """Bytes of the log."""
        return self.metrics_file.stat().st_size if self.metrics_file.exists() else 0

    def sync_log(self) -> int:
        """Flush the log to disk; returns its size in bytes."""
        if not self.metrics_file.exists():
            return 0
        with self.metrics_file.open("a") as file:
            os.fsync(file.fileno())
            return file.tell()

    def cut_log(self, size: int) -> bool:
        """Truncate the log to what a checkpoint covers; False if rows are missing."""
        if self.metrics_file.exists():
            os.truncate(self.metrics_file, min(size, self.log_size()))
        return self.log_size() == size

    def sweep(self) -> None:
        """Remove the temporary files of a killed process."""
        for folder in (self.path, self.state_file.parent):
            for leftover in folder.glob(f"*{TEMPORARY}"):
                leftover.unlink()

    def lock(self) -> None:
        """Hold the folder until `unlock` or the process ends; refuse a second holder."""
        try:
            file = (self.path / "lock").open("a+")
        except OSError as error:
            raise UsageError(f"run: cannot write {self.path}: {error.strerror}") from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            holder = file.read(200).strip() or "another process"
            file.close()
            raise InUseError(f"run: {self.path} is in use by {holder}") from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}\n")
        file.flush()
        self._lock = file

    def unlock(self) -> None:
        """Let another process have the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def in_use(self) -> bool:
        """Whether a process holds the folder now."""
        try:
            with (self.path / "lock").open() as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return False

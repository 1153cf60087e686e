"""The run directory: its files and its config."""

import json
import re
import shlex
from collections.abc import Iterable
from contextlib import suppress
from glob import escape, glob
from pathlib import Path
from typing import Any

from pacesetter.config import Config, resolve
from pacesetter.consent import require, words
from pacesetter.errors import InUseError, UsageError
from pacesetter.files import (
    NOT_REGULAR,
    TEMPORARY,
    is_regular,
    make_folder,
    present,
    read_bytes,
    write_atomically,
)
from pacesetter.policy import FILE
from pacesetter.runs.lock import WITHOUT, Lock
from pacesetter.runs.log import Log, Row
from pacesetter.runs.provenance import provenance
from pacesetter.runs.records import SCHEMA, check_record
from pacesetter.settings.validation import difference

CONFIG = "config.json"
# Settings that belong to the machine, not to the result; `resume` takes them anew.
WITHOUT_RESULT = {"checkpoint_every", "device", "env_timeout"}
# Settings that are newer than some runs, with the value by which those were made.
OLDER = {"eval_policy": "champion"}
# Settings in which the seeds of one name may differ.
HORIZONS = {"replay_horizon", "lr_horizon"}
FREE_PER_SEED = {"seed", "steps", "time"} | WITHOUT_RESULT | HORIZONS


class RunDirectory:
    """One run's folder, held by at most one process at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / CONFIG
        self.metrics_file = path / "metrics.jsonl"
        self.policy_file = path / FILE
        self.best_file = path / "best.safetensors"
        self.policies = path / "policies"  # of past evaluations, if they are kept
        self.state_file = path / "last" / "state.safetensors"
        self.previous_file = path / "last" / "previous.safetensors"
        self.checkpoints = [self.state_file, self.previous_file]
        self.log = Log(self.metrics_file)
        self._lock = Lock(path / "lock")
        self._made: list[Path] = []  # folders that `create` made, the innermost first
        self._is_new = False  # whether all files of a run that are here are of `create`

    @classmethod
    def of(cls, runs: str | Path, config: Config) -> "RunDirectory":
        """Where a run's settings place it: runs / env / name / seed."""
        run = config.run
        return cls(Path(runs) / re.sub(r"[/:]", "-", run.env) / run.name / str(run.seed))

    @property
    def files(self) -> list[Path]:
        """Every file that a run leaves here, but config and lock."""
        last = self.state_file.parent
        found = [self.metrics_file, self.policy_file, self.best_file]
        found += [self.state_file, self.previous_file, *last.glob("replay-*.bin")]
        return [file for file in found if present(file)]

    @property
    def has_checkpoint(self) -> bool:
        return any(map(present, self.checkpoints))

    def refuse_existing(self, config: Config) -> None:
        """Refuse to train where a run is already, and say what to do instead."""
        if not present(self.config_file):
            if found := self.files:
                raise UsageError(
                    f"run: {self.path} has a run's {found[0].name} but no {CONFIG}; put that back, "
                    "or give this run another --name"
                )
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
        run = config.run
        return ["resume", str(self.path), *words(run.algorithm, run.env, *run.wrap)]

    def difference_from(self, config: Config) -> str | None:
        """The first setting of another result in which the run here differs.

        None if none does, or no run is here.
        """
        if not present(self.config_file):
            return None
        old, new, own = self.settings(), config.settings(), ("algorithm", "env")
        if found := difference(old, new, own):  # a name of the file's own is not even looked up
            return found
        named = [*(new[name] for name in own), *old.get("wrap", ())]  # wrappers are only compared
        keys = [key for key in new if key not in WITHOUT_RESULT]
        return difference(self.config(named).settings(), new, keys)

    def _refuse_other_seeds(self, config: Config) -> None:
        """Refuse a new seed whose settings differ from those of the other seeds of its name."""
        new = json.loads(json.dumps(config.settings()))
        for file in sorted(map(Path, glob(f"{escape(str(self.path.parent))}/*/{CONFIG}"))):
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
            self._make_folders()
            self.lock()
            self.refuse_existing(config)  # another process may have been quicker
            self._is_new = True
            table = {"schema": SCHEMA, "settings": config.settings(), **provenance(**found)}
            self._write_config(table)
        except BaseException as error:
            self.remove()
            if isinstance(error, OSError):
                reason = f"cannot write {self.path}: {error.strerror}"
                raise UsageError(f"runs: {reason}") from None
            raise

    def _make_folders(self) -> None:
        last = self.state_file.parent
        for folder in (*reversed(last.parents), last):
            if make_folder(folder):
                self._made.insert(0, folder)

    def note_resume(self, config: Config, step: int, **found: Any) -> None:
        """Note in the config when and with what the run was resumed, and its settings now."""
        table = self.record()
        resumed = [*table.get("resumed", []), {"step": step, **provenance(**found)}]
        self._write_config(table | {"settings": config.settings(), "resumed": resumed})

    def remove(self) -> None:
        """Undo `create` for a run that cannot start: remove what it made and nothing else."""
        if self._is_new:
            self.sweep()
            for file in (*self.files, self.config_file, self._lock.path):
                file.unlink(missing_ok=True)
        self.unlock()
        with suppress(OSError):  # somebody else has put something there
            for folder in self._made:
                folder.rmdir()

    def remove_checkpoint(self) -> None:
        """Give back the disk that only `resume` needs."""
        last = self.state_file.parent
        for file in self.files:
            if file.parent == last:
                file.unlink()
        with suppress(OSError):  # somebody else has put something there
            last.rmdir()

    def _write_config(self, table: Row) -> None:
        # With Infinity, which other readers may not take: a task's keyword may be infinite, and
        # with null in its place the run would be another.
        write_atomically(self.config_file, (json.dumps(table, indent=1) + "\n").encode())

    def record(self) -> Row:
        """The whole config.json."""
        try:
            table = json.loads(read_bytes(self.config_file))
            check_record(table)
        except FileNotFoundError:
            raise UsageError(f"run: {self.path} holds no run (no config.json)") from None
        except OSError as error:
            raise UsageError(f"{self.config_file}: cannot be read: {error.strerror}") from None
        except (ValueError, RecursionError) as error:
            raise UsageError(f"{self.config_file}: damaged or foreign: {error}") from None
        return table

    def settings(self) -> Row:
        """The run's flat settings."""
        return OLDER | self.record()["settings"]

    def config(self, allow: Iterable[str] = ()) -> Config:
        """The run's checked settings; `allow` are names that may import a module."""
        settings = self.settings()
        for name in ("algorithm", "env"):
            require(name, settings[name], allow)
        for wrapper in settings.get("wrap", ()):
            require("wrap", str(wrapper), allow)
        try:
            return resolve(settings["algorithm"], settings["env"], settings)
        except KeyError as error:
            raise UsageError(f"{self.config_file}: damaged: {error} is missing") from None

    def rows(self, *kinds: str) -> list[Row]:
        """All complete rows of the log, or only those of some kinds."""
        return self.log.rows(*kinds)

    def sweep(self) -> None:
        """Remove the temporary files of a killed process."""
        for folder in (self.path, self.policies, self.state_file.parent):
            for leftover in folder.glob(f"*{TEMPORARY}"):
                try:
                    leftover.unlink()
                except OSError as error:
                    reason = f"cannot remove {leftover}: {error.strerror}"
                    raise UsageError(f"run: {reason}") from None

    def set_aside(self) -> list[str]:
        """Rename what is no regular file where the run writes one; a line about each."""
        notes: list[str] = []
        for file in (self.policy_file, self.best_file, self.state_file, self.previous_file):
            if not present(file) or is_regular(file):
                continue
            aside = file.with_name(f"{file.name}.aside")
            if present(aside):
                raise UsageError(f"run: {file} {NOT_REGULAR}; move it away")
            file.rename(aside)
            notes.append(f"{file}: {NOT_REGULAR}; it is {aside.name} now")
        return notes

    def lock(self) -> None:
        """Hold the folder until `unlock` or the process ends; refuse a second holder."""
        try:
            self._lock.take()
        except InUseError as error:
            raise InUseError(f"run: {error}") from None
        except OSError as error:
            raise UsageError(f"run: cannot write {self._lock.path}: {error.strerror}") from None

    @property
    def notes(self) -> list[str]:
        """What a person should know about how the folder is held."""
        return [f"{self.path}: {WITHOUT}"] if self._lock.is_weak else []

    def unlock(self) -> None:
        """Let another process have the folder."""
        self._lock.free()

    def in_use(self) -> bool:
        """Whether a process holds the folder now."""
        return self._lock.is_held()

    def holder(self) -> str | None:
        """Who holds the folder now, as `Lock.holder` tells."""
        return self._lock.holder()

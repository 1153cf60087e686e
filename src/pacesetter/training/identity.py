"""Which run a checkpoint is of: what must not differ between it and the run that takes it up."""

import json
from pathlib import Path
from typing import Any

from pacesetter import storage
from pacesetter.config import Config, resolve
from pacesetter.errors import UsageError
from pacesetter.runs import WITHOUT_RESULT, RunDirectory
from pacesetter.settings import Settings

KIND = "checkpoint"
SCHEMA = 4
# What a run is given anew by flags of `resume`, or what changes no result of it.
BUDGETS = {"steps", "time", "stop_at", "stop_patience"}
FREE_ON_RESUME = BUDGETS | WITHOUT_RESULT | {"name"}


class Refused(UsageError):  # noqa: N818
    """What the checkpoint before would not cure."""


def identity(config: Config) -> dict[str, Any]:
    """What tells one run from another."""
    names = ("algorithm", "env", "env_kwargs", "seed", "members")
    wrap = {"wrap": [*config.run.wrap]} if config.run.wrap else {}  # which older ones do not name
    return {name: getattr(config.run, name) for name in names} | wrap


def fixed(config: Config) -> Settings:
    """The settings that a run keeps, as JSON gives them back."""
    return json.loads(
        json.dumps({k: v for k, v in config.settings().items() if k not in FREE_ON_RESUME})
    )


def with_new(config: Config, **given: Any) -> Config:
    """The config with those of the given settings that are not None."""
    changed = {name: value for name, value in given.items() if value is not None}
    if not changed:
        return config
    return resolve(config.run.algorithm, config.run.env, config.settings() | changed)


def refuse_other_settings(config: Config, directory: RunDirectory) -> None:
    """Refuse to go on with settings that the newest checkpoint was not made with.

    Old checkpoints do not tell; a setting that is newer than the checkpoint is no difference.
    """
    for file in (directory.state_file, directory.previous_file):
        try:
            made_with: dict[str, Any] = storage.read(file, KIND).table.get("settings", {})
        except UsageError:  # which `restore` will tell
            continue
        now = fixed(config)
        found = [key for key in now if key in made_with and now[key] != made_with[key]]
        if found:
            differences = ", ".join(f"{key}={now[key]}, not {made_with[key]}" for key in found)
            raise UsageError(
                f"{directory.config_file}: has {differences} as in its checkpoint; put that back, "
                "or train under another --name"
            )
        return


def device_notes(directory: RunDirectory, now: str) -> list[str]:
    """A line if the run was last made on another kind of device than it is now."""
    record = directory.record()
    before = [record, *record.get("resumed", [])][-1].get("backend", now)
    if before == now:
        return []
    return [f"made on {before}, going on with {now}: results will differ in their last bits"]


def refuse_strangers(file: Path, table: dict[str, Any], config: Config) -> None:
    """Refuse a checkpoint of another schema or of another run."""
    schema = table.get("schema")
    if schema == 3:
        raise Refused(
            f"{file}: checkpoint schema 3 was made by an earlier pacesetter 0.1, this version "
            f"reads {SCHEMA}; resume the run with the commit that its config.json names, or train "
            "it again under another --name"
        )
    if schema != SCHEMA:
        raise UsageError(
            f"{file}: checkpoint schema {schema}, this version reads {SCHEMA}; "
            "use the version of pacesetter that wrote it"
        )
    if table.get("run") != identity(config):
        raise UsageError(
            f"{file}: is of another run: {table.get('run')}; put this run's own file back"
        )

"""A whole run to a file and back, bit for bit: learners, replay, envs, random streams, counters."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pacesetter import storage
from pacesetter.ensemble.members import Ensemble
from pacesetter.ensemble.progress import Progress
from pacesetter.envs import Snapshot
from pacesetter.errors import TrainingError, UsageError
from pacesetter.policy import Policy
from pacesetter.process import threads
from pacesetter.runs import RunDirectory
from pacesetter.storage import Content
from pacesetter.training.on_policy import Iterations
from pacesetter.types import Arrays

KIND = "checkpoint"
SCHEMA = 3

Learning = Ensemble | Iterations


def save(ensemble: Learning, directory: RunDirectory) -> None:
    """Write the checkpoint; the one before it stays as previous.safetensors."""
    arrays = {
        **_flatten("states", ensemble.states),
        **_flatten("memory", ensemble.memory),
        "normalizer": ensemble.normalizer.sums,
    }
    _refuse_faults(arrays, ensemble.progress.step)
    episodes: list[int] = []
    for index, env in enumerate(ensemble.envs):
        snapshot, member = env.snapshot(), ensemble.progress.members[index]
        if member.starting or not member.active:  # its episode is over: only its number counts
            nothing = np.zeros_like(snapshot.observation)
            snapshot = Snapshot(snapshot.episode, snapshot.actions[:0], nothing)
        episodes.append(snapshot.episode)
        arrays[f"env.{index}.actions"] = snapshot.actions
        arrays[f"env.{index}.observation"] = snapshot.observation
    for index, pending in enumerate(ensemble.pending):
        arrays |= _named(f"pending.{index}", pending.arrays())
    for index, policy in enumerate(ensemble.kept):
        arrays |= _flatten(f"kept.{index}", policy and _parts(policy))
    for index, replay in enumerate(ensemble.replays):
        arrays |= _named(f"replay.{index}", replay.arrays())
    table = {
        "schema": SCHEMA,
        "threads": threads(),
        "progress": ensemble.progress.table(),
        "streams": [rng.bit_generator.state for rng in ensemble.streams],
        "episodes": episodes,
        "kept": [policy and policy.about for policy in ensemble.kept],
        "replays": [replay.commit() for replay in ensemble.replays],
        "log": directory.sync_log(),
        "run": _identity(ensemble),
    }
    storage.write(directory.state_file, KIND, Content(arrays, table), directory.previous_file)


def restore(ensemble: Learning, directory: RunDirectory) -> list[str]:
    """Take up the newest checkpoint that is whole; what a person should know about it, in lines."""
    notes: list[str] = []
    files = [directory.state_file, directory.previous_file]
    for file in (file for file in files if file.exists()):
        try:
            _restore(ensemble, directory, file, notes)
        except UsageError as error:
            notes.append(f"{error}; trying the checkpoint before it")
            continue
        if file != directory.state_file:  # the next save must not keep the damaged one instead
            storage.link(file, directory.state_file)
        return notes
    if not notes and directory.log_size():
        notes = [f"{directory.state_file}: is missing"]
    if notes:
        raise UsageError(
            f"{notes[0].split(';')[0]}; no whole checkpoint is left in {directory.path}"
        )
    return ["no checkpoint yet, starting from the beginning"]


def _restore(ensemble: Learning, directory: RunDirectory, file: Path, notes: list[str]) -> None:
    arrays, table = storage.read(file, KIND)
    if table.get("schema") != SCHEMA:
        raise UsageError(
            f"{file}: checkpoint schema {table.get('schema')}, this version reads {SCHEMA}"
        )
    if table.get("run") != _identity(ensemble):
        raise UsageError(f"{file}: is of another run: {table.get('run')}")
    try:
        states = jax.tree.map(jax.numpy.array, _rebuild("states", ensemble.states, arrays))
        memory = _rebuild("memory", ensemble.memory, arrays)
        kept = _kept(ensemble, table["kept"], arrays)
        for index, pending in enumerate(ensemble.pending):
            pending.restore(_below(f"pending.{index}", arrays))
        for index, part in enumerate(table["replays"]):
            ensemble.replays[index].restore(part, _below(f"replay.{index}", arrays))
        ensemble.progress = Progress.load(table["progress"])
        ensemble.normalizer.sums = arrays["normalizer"]
        for rng, state in zip(ensemble.streams, table["streams"], strict=True):
            rng.bit_generator.state = state
        _enter_episodes(ensemble, table["episodes"], arrays, notes)
    except storage.FAULTS as error:
        raise UsageError(f"{file}: does not fit this run: {error}") from None
    ensemble.states, ensemble.memory, ensemble.kept = states, memory, kept
    ensemble.acting = ensemble.population.policy_params(states)
    if not directory.cut_log(int(table["log"])):
        notes.append(f"{directory.metrics_file}: rows of the log are missing")
    if table["threads"] != threads() and ensemble.progress.step < ensemble.budget:
        notes.append(
            f"made with {table['threads']} threads, going on with {threads()}: "
            "results will differ in their last bits"
        )


def _enter_episodes(
    ensemble: Learning, episodes: list[int], arrays: Arrays, notes: list[str]
) -> None:
    for index, (env, episode) in enumerate(zip(ensemble.envs, episodes, strict=True)):
        actions, observation = (
            arrays[f"env.{index}.{part}"] for part in ("actions", "observation")
        )
        member = ensemble.progress.members[index]
        if member.starting or not member.active:
            env.episode = episode
        elif not (
            env.restore(Snapshot(episode, actions, observation))
            and env.earned == member.episode_return
        ):
            notes.append(
                f"member {index}: {env.name} does not repeat an episode exactly; a new one starts"
            )
            ensemble.abandon(index)


def _kept(ensemble: Learning, abouts: list[Any], arrays: Arrays) -> list[Policy | None]:
    kept: list[Policy | None] = []
    for index, about in enumerate(abouts):
        policy = None
        if about is not None:
            policy = ensemble.current(index)
            actors, normalizer = _rebuild(f"kept.{index}", _parts(policy), arrays)
            policy = replace(policy, actors=actors, normalizer=normalizer, about=about)
        kept.append(policy)
    return kept


def _parts(policy: Policy) -> Any:
    return policy.actors, policy.normalizer


def _named(prefix: str, arrays: Arrays) -> Arrays:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def _below(prefix: str, arrays: Arrays) -> Arrays:
    start = f"{prefix}."
    return {key.removeprefix(start): x for key, x in arrays.items() if key.startswith(start)}


def _flatten(prefix: str, tree: Any) -> Arrays:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(prefix, path): np.asarray(leaf) for path, leaf in leaves}


def _rebuild(prefix: str, like: Any, arrays: Arrays) -> Any:
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    found: list[Any] = []
    for path, leaf in leaves:
        array = arrays[_name(prefix, path)]
        if array.shape != leaf.shape or array.dtype != leaf.dtype:
            raise ValueError(f"{_name(prefix, path)} is {array.shape}, expected {leaf.shape}")
        found.append(array)
    return jax.tree.unflatten(structure, found)


def _name(prefix: str, path: Any) -> str:
    return f"{prefix}.{jax.tree_util.keystr(path, simple=True, separator='.')}"


def _identity(ensemble: Learning) -> dict[str, Any]:
    run = ensemble.config.run
    names = ("algorithm", "env", "env_kwargs", "seed", "members")
    return {name: getattr(run, name) for name in names}


def _refuse_faults(arrays: Arrays, step: int) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            part, member, *_ = [*name.split("."), ""]
            where = f"member {member}, " if part == "states" else ""
            raise TrainingError(f"{where}step {step}: {name} is not finite")

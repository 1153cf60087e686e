"""The networks of an earlier run, or the actor of a policy file, as the start of a new run."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from pacesetter import policy, storage
from pacesetter.config import Config
from pacesetter.ensemble.loop import Loop
from pacesetter.errors import UsageError
from pacesetter.learner.tree_arrays import below, flatten, rebuild
from pacesetter.runs import find


def start_from(loop: Loop, config: Config, runs: str | Path) -> None:
    """Give every member what `--start-from` names, if it names anything.

    The replay, the counters and noise start anew. A run gives the whole state of its champion,
    optimiser state included but no EMA actor, and the statistics that normalize observations and
    rewards. A policy file gives the actor alone. Raises UsageError if it does not fit this run.
    """
    if config.run.start_from is None:
        return
    source = str(config.run.start_from)
    try:
        if file := policy.file_of(source):
            _from_policy(loop, config, file)
        else:
            _from_run(loop, config, source, runs)
    except storage.FAULTS as error:
        raise UsageError(f"start_from: {source} does not fit this run: {error}") from None


def _from_run(loop: Loop, config: Config, source: str, runs: str | Path) -> None:
    directory = find(source, runs)
    arrays, table = storage.read(directory.state_file, "checkpoint")
    old = {**directory.settings(), **table["run"]}
    new = config.settings()
    for name in ("algorithm", "normalize_observation", "normalize_reward"):
        if old.get(name, False) != new.get(name, False):
            raise UsageError(
                f"start_from: {directory.path} has {name}={old.get(name)}, this run "
                f"{new.get(name)}; they must be the same"
            )
    champion = int(table["progress"]["champion"])
    found = below(f"states.{champion}", arrays)
    learner, states = loop.learners.compiled.learner, loop.learners.states
    loop.learners.replace([learner.restarted(_copied(state, found)) for state in states])
    parts = loop.parts()
    parts["normalizer"].restore({}, below("normalizer", arrays))
    if "returns" in parts:  # the critics' values are in units of its deviation
        fresh = parts["returns"].arrays()
        parts["returns"].restore({}, fresh | {"sums": below("returns", arrays)["sums"]})


def _from_policy(loop: Loop, config: Config, file: Path) -> None:
    found = policy.load(file)
    if len(found.actors) > 1:
        raise UsageError(
            f"start_from: {file} averages {len(found.actors)} actors, and a member has one; name "
            "the run that it comes from"
        )
    if found.normalizer is not None:
        raise UsageError(
            f"start_from: {file} acts on normalized observations, whose statistics a run keeps; "
            "name the run that it comes from"
        )
    if config.hyper.normalize_observation:
        raise UsageError(
            f"start_from: {file} acts on the task's own observations; give "
            "--no-normalize-observation, or name a run that has it"
        )
    learner, states = loop.learners.compiled.learner, loop.learners.states
    own = learner.policy(states[0])
    if (found.activation, found.output) != (own.activation, own.output):
        raise UsageError(
            f"start_from: {file} has an actor of {found.activation} and {found.output}, this run's "
            f"has {own.activation} and {own.output}; name a file of the same kind of algorithm"
        )
    loop.learners.replace([learner.with_actor(state, found.actors[0]) for state in states])


def _copied(like: Any, arrays: storage.Arrays) -> Any:
    """A state of its own, since an update uses it up; a ValueError names what it has no place for.

    Such as the gains of layer norm, without which the other weights would be another network.
    """
    extra = sorted(arrays.keys() - flatten(like).keys() - {"exploration"})
    if extra:  # a noise that this run does not have is no part of the networks
        raise ValueError(f"it also has {extra[0]}")
    return jax.tree.map(jnp.array, rebuild(like, arrays))

"""Experiment: a number of a run becomes NaN, infinite or 1e38, wherever one can."""

import random
import re
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from attempts import Tally
from short_runs import TINY, run_to_end

from pacesetter import storage
from pacesetter.ensemble.updates import CHECK_EVERY
from pacesetter.errors import TrainingError
from pacesetter.learner.tree_arrays import flatten
from pacesetter.training.trainer import Trainer
from pacesetter.types import DIVERGED, LARGEST, worst

SETTINGS: dict[str, Any] = TINY | {"hidden": (8,), "steps": 600, "eval_every": 300}
ROLLOUTS: dict[str, Any] = {"parallel_envs": 2, "rollout_length": 20}
ALGORITHMS: dict[str, dict[str, Any]] = {
    "td3": SETTINGS | {"members": 2},
    "sac": SETTINGS | {"members": 2},
    "trpo": {"hidden": (8,), "steps": 600, "eval_every": 300, "eval_episodes": 1} | ROLLOUTS,
}
VALUES = (np.nan, np.inf, 1e38)


class Case:
    """A trainer, and a value that is put somewhere when some steps are made."""

    def __init__(self, trainer: Trainer, value: float, rng: random.Random) -> None:
        self.trainer, self.value, self.rng = trainer, value, rng
        self.member = rng.randrange(len(trainer.loop.learners.states))
        self.at = rng.randrange(250, 350)  # steps of the run
        self.calls: int | None = None  # of the member's update when it was done

    def alter(self, holder: Any, name: str, change: Callable[[Any], Any], of: int = 0) -> None:
        """Change once what a method gives, whose first argument `of` is the member's."""
        method = getattr(holder, name)

        def altered(*words: Any, **named: Any) -> Any:
            given = method(*words, **named)
            if self.calls is not None or self.trainer.progress.step < self.at:
                return given
            if of and words[of] != self.member:
                return given
            self.calls = self.update_calls
            return change(given)

        setattr(holder, name, altered)

    def spoil(self, array: Any) -> Any:
        """A copy with the value at a place of it."""
        spoiled = np.array(array, np.float32)
        spoiled.flat[self.rng.randrange(spoiled.size)] = self.value
        return spoiled

    @property
    def update_calls(self) -> int:
        """How often the member was updated."""
        progress = self.trainer.progress
        return progress.members[self.member].update_calls or progress.updates


def _observation(case: Case) -> None:
    env = case.trainer.loop.explorers[case.member].env.env
    case.alter(env, "step", lambda given: (case.spoil(given[0]), *given[1:]))


def _reward(case: Case) -> None:
    env = case.trainer.loop.explorers[case.member].env.env
    case.alter(env, "step", lambda given: (given[0], case.value, *given[2:]))


def _action(case: Case) -> None:
    case.alter(case.trainer.loop.explorers[case.member], "act", case.spoil)


def _loss(case: Case) -> None:
    def change(given: Any) -> Any:
        return given._replace(losses=case.spoil(given.losses))

    case.alter(case.trainer.loop.learners.compiled, "update", change, of=1)


def _weight(case: Case) -> None:
    _spoil_state(case, moments=False)


def _moment(case: Case) -> None:
    _spoil_state(case, moments=True)


def _spoil_state(case: Case, moments: bool) -> None:
    states = case.trainer.loop.learners.states

    def change(given: Any) -> Any:
        leaves, structure = jax.tree.flatten(states[case.member])
        names = [*flatten(states[case.member])]
        places = [
            place
            for place, (name, leaf) in enumerate(zip(names, leaves, strict=True))
            if leaf.dtype == np.float32 and leaf.size and ("opt_state" in name) == moments
        ]
        place = case.rng.choice(places)
        leaves[place] = jax.numpy.asarray(case.spoil(leaves[place]))
        states[case.member] = jax.tree.unflatten(structure, leaves)
        return given

    case.alter(case.trainer.loop, "tick", change)


SITES = {
    "observation": (_observation, "observation: must be"),
    "reward": (_reward, "reward: must be"),
    "action": (_action, "action: must be"),
    "loss": (_loss, r"\w+ is "),
    "weight": (_weight, r"[\w.]+:? (is|holds|must be) "),
    "moment": (_moment, r"[\w.]+:? (is|holds|must be) "),
}


def run(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many runs with one wrong number, of every kind in turn."""
    rng, tally = random.Random(seed), Tally()
    cases = [*product(ALGORITHMS, VALUES, SITES)]
    for number in range(count):
        algorithm, value, site = cases[(number + seed) * 7 % len(cases)]
        settings = ALGORITHMS[algorithm] | {"checkpoint_every": rng.choice([0.02, 3600])}
        trainer = Trainer(algorithm, "Pendulum-v1", runs=folder / str(number), **settings)
        case = Case(trainer, value, rng)
        put, named = SITES[site]
        put(case)
        fault = _found(case, named) or _stored(trainer) or _beyond(trainer)
        tally.made += 1
        if fault:
            about = f"{algorithm}, {site} {value} in member {case.member} at {case.at}"
            tally.wrong.append(f"{about}: {fault}")
    return tally


def _found(case: Case, named: str) -> str:
    """What is wrong with how the run ended."""
    try:
        run_to_end(case.trainer)
    except TrainingError as error:
        who = rf"(member|env) {case.member}, step \d+: "
        if not re.match(who + f"(Pendulum-v1: )?{named}", str(error)):
            return f"not named: {error}"
        if case.calls is None or case.update_calls > case.calls + CHECK_EVERY:
            return f"found late: {error}"
        return ""
    return "not found"


def _stored(trainer: Trainer) -> str:
    """What wrong number lies in a file of the run."""
    for file in trainer.directory.path.rglob("*.safetensors"):
        kind = "checkpoint" if file.parent.name == "last" else "policy"
        for name, array in storage.read(file, kind).arrays.items():
            limit = LARGEST if name.startswith(("env", "queue")) else DIVERGED
            if worst(array, limit) is not None:
                return f"{name} of {file.name} holds {worst(array, limit)}"
    return ""


def _beyond(trainer: Trainer) -> str:
    """What is wrong with the run's rest, without the fault."""
    again = Trainer.resume(trainer.directory.path)
    for replay in again.loop.replays:
        if worst(replay.rows, LARGEST) is not None:
            return "the replay holds it"
    run_to_end(again)
    return "" if again.finished and not again.notes else f"does not end: {again.notes}"

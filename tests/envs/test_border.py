"""What a task gives is cast where it can be, noted once, and refused otherwise."""

from typing import Any

import numpy as np
import pytest
from odd_envs import Mute
from short_runs import TINY, log, run_to_end

from pacesetter.envs import Environment, Recipe, border
from pacesetter.errors import reason, show
from pacesetter.evaluation import rollouts
from pacesetter.seeding import Stream
from pacesetter.training.trainer import Trainer

NOTES = {
    "ListObservation": ["observation is a list, taken as an array"],
    "WideObservation": ["observation is float64 in a space of float32, cast to float32"],
    "OutsideObservation": ["number 2 is -10.0, outside its space [-9.0, 9.0]"],
    "RoundedObservation": [],
    "LineReward": ["reward is of shape (1,), taken as one number"],
    "PointReward": ["reward is of type ndarray, taken as one number"],
    "BoolReward": ["reward is of type bool, taken as one number"],
    "IntFlags": ["terminated is of type int, taken as a flag; truncated is of type int"],
    "LineFlags": ["terminated is of shape (1,), taken as a flag; truncated is of shape (1,)"],
    "OddInfo": [],
}


def world(name: str) -> Environment:
    return Environment(Recipe(f"odd_envs:{name}-v0"), 3, Stream.TRAIN)


@pytest.mark.parametrize("name", NOTES)
def test_what_is_cast_is_noted_in_one_line(name: str) -> None:
    notes = world(name).check()
    assert len(notes) == bool(NOTES[name])
    for note in notes:
        assert "\n" not in note
        assert note.startswith(f"env: odd_envs:{name}-v0: ")
        assert NOTES[name][0] in note


@pytest.mark.parametrize("name", ["WideObservation", "LineReward", "PointReward", "LineFlags"])
def test_what_is_cast_is_what_was_meant(name: str, rng: np.random.Generator) -> None:
    """Steps equal those of the task that gives them as it should, in value and in type."""
    plain, odd = Environment(Recipe("broken_envs:Probe-v0"), 3, Stream.TRAIN), world(name)
    assert np.array_equal(plain.reset(), odd.reset())
    for _ in range(100):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        one, other = plain.step(action), odd.step(action)
        assert np.array_equal(one.observation, other.observation)
        assert other.observation.dtype == np.float32
        assert one[1:4] == other[1:4]
        assert [type(value) for value in other[1:4]] == [float, bool, bool]
    assert (odd.earned, other.truncated) == (plain.earned, True)


def test_a_run_notes_casts_once_and_learns_the_same(runs: Any) -> None:
    settings = {**TINY, "steps": 250, "eval_every": 250, "runs": runs}
    wide = Trainer("td3", "odd_envs:WideObservation-v0", **settings)
    (note,) = wide.notes
    assert "float64" in note
    plain = Trainer("td3", "broken_envs:Probe-v0", **settings)
    assert plain.notes == []
    assert log(run_to_end(wide)) == log(run_to_end(plain))
    again = Trainer.resume(wide.directory.path, steps=260)
    again.close()
    assert again.notes == []


def test_info_may_have_any_keys() -> None:
    """Of them the terms of the reward are averaged."""
    env = world("OddInfo")
    found = rollouts(lambda observation: np.zeros(2, np.float32), env, 2)
    assert found.terms == {"reward_lean": 50.0}


REFUSED: list[tuple[Any, str]] = [
    ({"a": 1}, "must be numbers"),
    ([[1.0], [2.0, 3.0], [1.0]], "must be numbers"),
    (np.zeros(3, complex), "must be numbers"),
    (np.array(["1", "2", "3"]), "must be numbers"),
    (None, "must be numbers|must have shape"),
    (Mute(), "must be numbers, got a Mute that cannot be printed"),
    (np.zeros((3, 1)), r"must have shape \(3,\) as its space, has \(3, 1\)"),
    ([0.0, 1e300, 0.0], r"must be finite and at most 1.8e\+19 in size, number 1 is 1e\+300"),
    (np.float32([-1e38, 0, 0]), r"must be finite and at most .*, number 0 is -\S+e\+3[78]"),
    (np.float16([0, np.inf, 0]), "must be finite and at most .*, number 1 is inf"),
    (np.float32([0, 0, np.nan]), "must be finite and at most .*, number 2 is nan"),
]


@pytest.mark.parametrize(("given", "why"), REFUSED)
def test_observations_that_are_refused(given: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        border.observation(given, (3,))


def test_one_number_is_an_observation_of_one() -> None:
    for given in (0.5, np.float64(0.5), np.array(0.5), np.array([0.5]), [0.5]):
        for shape in ((), (1,)):
            assert border.observation(given, shape).tolist() == [0.5]


@pytest.mark.parametrize("given", ["1", None, 1j, np.complex64(1), [], [1, 2], [[1], [1, 2]], {}])
def test_rewards_that_are_refused(given: Any) -> None:
    with pytest.raises(ValueError, match="must be one number, got"):
        border.reward(given)


def test_rewards_too_large_to_learn_from() -> None:
    for given in (10**400, 10**5000, np.float16("inf"), np.array([np.nan]), -1e39, 1e20):
        with pytest.raises(ValueError, match="must be finite and at most"):
            border.reward(given)


@pytest.mark.parametrize("given", [2, -1, 0.5, np.nan, np.array([True, False]), "", None, []])
def test_flags_that_are_refused(given: Any) -> None:
    with pytest.raises(ValueError, match=r"must be True or False|must be one number"):
        border.flag("terminated", given)


def test_the_reason_of_an_exception() -> None:
    """Kind and whole text; without a text, the place; and what cannot be printed is only named."""
    assert reason(OSError("no file\n  at all")) == "OSError: no file\n  at all"
    assert reason(ValueError()) == "ValueError"
    assert reason(Mute()) == "Mute"
    assert show(Mute()) == "a Mute that cannot be printed"
    assert len(show(list(range(10**5)))) < 100

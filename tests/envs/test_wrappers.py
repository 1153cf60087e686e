"""Wrappers by name and flattened observations, in every verb that plays a task."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken_envs import Probe
from gymnasium.spaces import Box, Dict
from short_runs import TINY, assert_same, log, run_to_end, run_to_step

from pacesetter.cli.main import main
from pacesetter.envs import Environment, Recipe
from pacesetter.envs.spaces import refuse_images
from pacesetter.errors import UsageError
from pacesetter.evaluation import evaluate
from pacesetter.policy import load
from pacesetter.seeding import Stream
from pacesetter.training.trainer import Trainer

PROBE = "broken_envs:Probe-v0"
BOTH = ("odd_envs:Doubled", "odd_envs:Raised")
RUN = {**TINY, "steps": 250, "eval_every": 250}


def world(name: str, *wrap: str) -> Environment:
    return Environment(Recipe(f"odd_envs:{name}-v0", {}, wrap), 3, Stream.TRAIN)


def test_a_dict_is_flattened_and_said(rng: np.random.Generator) -> None:
    """By Gymnasium's own wrapper: the same numbers as the plain task's."""
    goal, plain = world("Goal"), Environment(Recipe(PROBE), 3, Stream.TRAIN)
    (note,) = goal.check()
    assert "observation is a Dict (place, clock), flattened to (3,) numbers" in note
    assert plain.check() == []
    assert np.array_equal(goal.reset(0), plain.reset(0))
    for _ in range(50):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        plain.step(action)
        assert np.array_equal(goal.step(action).observation, plain.observation)
    (note,) = world("Pair").check()
    assert "observation is a Tuple (2 parts), flattened to (5,) numbers" in note


def test_what_was_flattened_is_not_flattened_for_an_image() -> None:
    """Unless a wrapper is asked for, which is then the user's own choice."""
    with pytest.raises(UsageError, match="image of 8x8x3 uint8"):
        world("Image")
    flat = world("Image", "gymnasium.wrappers:FlattenObservation")
    assert flat.observation_size == 192


@pytest.mark.parametrize(
    ("shape", "kind", "is_image"),
    [
        ((84, 84, 3), np.float32, True),
        ((4, 84, 84), np.float32, True),
        ((64, 64), np.uint8, True),
        ((8, 8, 3), np.uint8, True),
        ((20, 3, 3), np.float32, False),  # rotations of twenty joints
        ((64, 64), np.float32, False),  # a matrix
        ((200,), np.uint8, False),
    ],
)
def test_what_is_taken_for_an_image(shape: tuple[int, ...], kind: Any, is_image: bool) -> None:
    space = Box(0, 1, shape, kind)
    if not is_image:
        refuse_images("X", space)
        return
    with pytest.raises(UsageError, match="is an image of"):
        refuse_images("X", Dict(camera=space))


def test_wrappers_are_applied_in_order() -> None:
    """The first is the innermost."""
    still = np.zeros(2, np.float32)
    rewards: list[float] = []
    for wrap in ((), BOTH, BOTH[::-1]):
        env = Environment(Recipe(PROBE, {}, wrap), 3, Stream.TRAIN)
        env.reset()
        rewards.append(env.step(still).reward)
    assert rewards[1:] == [2 * rewards[0] + 1, 2 * (rewards[0] + 1)]


def test_run_with_wrappers_resumes_and_is_scored_with_them(tmp_path: Path) -> None:
    """They are of the run's config and of its policy file."""
    whole = run_to_end(Trainer("td3", PROBE, runs=tmp_path / "whole", wrap=BOTH, **RUN))
    parts = run_to_step(Trainer("td3", PROBE, runs=tmp_path / "parts", wrap=BOTH, **RUN), 120)
    assert_same(whole, run_to_end(Trainer.resume(parts.path)))
    assert whole.settings()["wrap"] == [*BOTH]
    bare = run_to_end(Trainer("td3", PROBE, runs=tmp_path / "bare", **RUN))
    assert log(bare)[0]["mean"] * 2 + 100 == pytest.approx(log(whole)[0]["mean"])
    policy = load(whole.policy_file)
    assert policy.about["wrap"] == [*BOTH]
    own, plain = evaluate(policy, episodes=2), evaluate(policy, Recipe(PROBE), episodes=2)
    assert own.returns == pytest.approx([2 * value + 100 for value in plain.returns])


def test_wrappers_of_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trained with two flags, evaluated with the run's own, and with others if they are given."""
    monkeypatch.chdir(tmp_path)
    flags = ["--steps", "120", "--warmup", "110", "--hidden", "8", "--eval-episodes", "1", "-q"]
    wrap = ["--wrap", BOTH[0], "--wrap", BOTH[1]]
    assert main(["train", "td3", PROBE, *wrap, *flags]) == 0
    assert main(["train", "td3", PROBE, "--name", "bare", *flags]) == 0
    capsys.readouterr()
    score: Any = ["eval", "runs/broken_envs-Probe-v0/td3/0", "--episodes", "1", "--json"]
    means: list[float] = []
    for more in ([], ["--wrap", BOTH[0]]):
        assert main([*score, "--allow", PROBE, *more]) == 0
        means.append(json.loads(capsys.readouterr().out)["mean"])
    assert means[0] == pytest.approx(means[1] + 100)


def test_wrappers_from_a_file_are_not_imported_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As every name that imports a module."""
    directory = run_to_end(Trainer("td3", PROBE, runs=tmp_path, **RUN | {"steps": 50}))
    table = json.loads(directory.config_file.read_text())
    table["settings"]["wrap"] = ["evil_module:Wrapper"]
    directory.config_file.write_text(json.dumps(table))
    assert main(["resume", str(directory.path), "--steps", "60"]) == 2
    assert "wrap: a file names 'evil_module:Wrapper'" in capsys.readouterr().err
    settings = tmp_path / "settings.toml"
    settings.write_text('wrap = ["evil_module:Wrapper"]')
    assert main(["train", "td3", PROBE, "--config", str(settings)]) == 2
    assert "wrap: a file names 'evil_module:Wrapper'" in capsys.readouterr().err
    policy = load(directory.policy_file)
    policy.about["wrap"] = ["evil_module:Wrapper"]
    policy.save(directory.policy_file)
    assert main(["eval", str(directory.policy_file), "--episodes", "1"]) == 2
    assert "wrap: a file names 'evil_module:Wrapper'" in capsys.readouterr().err


def test_function_in_the_place_of_an_id(tmp_path: Path) -> None:
    """The run is the same as by the id, and resumes when the function is given again."""

    def make_probe(gain: float = 1.0) -> Any:
        return Probe(gain)

    def same_probe() -> Any:
        return one

    one = Probe()
    by_id = run_to_end(Trainer("td3", PROBE, runs=tmp_path, **RUN))
    parts = run_to_step(Trainer("td3", make_probe, runs=tmp_path, **RUN), 120)
    assert parts.path == tmp_path / "function-make_probe" / "td3" / "0"
    with pytest.raises(UsageError, match="was given as a function; give it again"):
        Trainer.resume(parts.path)
    assert log(run_to_end(Trainer.resume(parts.path, env=make_probe))) == log(by_id)
    for function, why in ((same_probe, "new env at each call"), (dict, "must give an env")):
        with pytest.raises(UsageError, match=why):
            Trainer("td3", function, runs=tmp_path, **RUN)

"""Mean actions: what is averaged, on which starts, and that training never notices."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numeric import same
from scripted_runs import IDLE, start
from short_runs import content, log, run_to_end

from pacesetter import storage
from pacesetter.ensemble.averages import mean_action
from pacesetter.ensemble.rules import Choice
from pacesetter.policy import Policy, load
from pacesetter.runs import RunDirectory
from pacesetter.training.trainer import Trainer


def evaluations(directory: RunDirectory) -> list[dict[str, Any]]:
    return [row for row in log(directory) if row["kind"] == "eval"]


def acting(value: float, mean: float = 0.0) -> Policy:
    """A policy of one layer whose action is tanh(value * (x - mean))."""
    layer = {"kernel": np.array([[value]], np.float32), "bias": np.zeros(1, np.float32)}
    statistics = np.full(1, mean, np.float32), np.ones(1, np.float32)
    box = np.ones(1, np.float32)
    return Policy([[layer]], "relu", "tanh", -box, box, statistics)


def test_mean_action_is_that_of_actions_not_of_weights() -> None:
    """Each policy by its own statistics: tanh(2 (x - 1)) and tanh(-x), averaged."""
    act, x = mean_action([acting(2, 1), acting(-1)]), np.array([3.0], np.float32)
    expected = (np.tanh(4) + np.tanh(-3)) / 2
    np.testing.assert_allclose(act(x), [expected], rtol=1e-6)
    assert act(x).dtype == np.float32


def test_ensembles_log_both_means_and_one_member_none(runs: Path) -> None:
    many = evaluations(run_to_end(start(runs, name="many", eval_every=50, eval_episodes=2)))
    for row in many:
        assert set(row["mean_actions"]) == {"members", "ema"}
        for found in row["mean_actions"].values():
            assert found["mean"] == np.mean(found["returns"])
            assert found["std"] == np.std(found["returns"])
            assert len(found["returns"]) == 2
    one = run_to_end(start(runs, algorithm="td3", name="one"))
    off = run_to_end(start(runs, name="off", mean_actions="off"))
    for row in [*evaluations(one), *evaluations(off)]:
        assert "mean_actions" not in row
    (alone, *_) = evaluations(
        run_to_end(start(runs, algorithm="td3", name="on", mean_actions="on"))
    )
    assert set(alone["mean_actions"]) == {"ema"}  # that of all members is the champion's


@pytest.mark.parametrize("more", [{}, {"normalize_observation": True, "assess": 1}])
def test_training_never_notices(more: dict[str, Any], runs: Path) -> None:
    """With and without mean actions: learners, replay, envs, streams and counters end the same."""
    found: list[Any] = []
    for name, settings in (
        ("on", {"mean_actions": "on", "snapshots": 3}),
        ("off", {"mean_actions": "off"}),
    ):
        run = content(run_to_end(start(runs, name=name, eval_every=30, **settings, **more)))
        del run["table"]["averages"]
        arrays = {n: x for n, x in run["arrays"].items() if not n.startswith("averages.")}
        apart = {"mean_actions", "members"}
        rows = [{n: x for n, x in row.items() if n not in apart} for row in run["log"]]
        found.append((arrays, run["table"], rows))
    (one, *rest), (other, *others) = found
    assert same(one, other)
    assert rest == others


def test_ema_actor_follows_by_its_tau(runs: Path) -> None:
    """Told again in NumPy: the first update's actor, then a step of 0.2 towards each later one."""
    trainer = start(runs, rule="none", ema_tau=0.2, steps=60)
    averages, told = trainer.loop.averages, dict[int, Any]()
    follow = averages.follow

    def watched(k: int) -> None:
        actor = jax.device_get(trainer.loop.learners.states[k].actor)
        tau = 0.2 if k in told else 1.0
        told[k] = jax.tree.map(lambda x, y: (1 - tau) * x + tau * y, told.get(k, actor), actor)
        follow(k)

    averages.follow = watched
    run_to_end(trainer)
    for k, expected in told.items():
        found = jax.tree.map(lambda x: x[0], averages.ema[k])
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6),
            *map(list, (found, expected)),
        )
    assert set(told) == {0, 1}


def test_copies_take_over_the_ema_actor(runs: Path) -> None:
    """By parents as it is; by weights the mean, in its floating-point leaves."""
    trainer = start(runs, steps=60, rule="none")
    run_to_end(trainer)
    averages = trainer.loop.averages
    first, second = jax.device_get(averages.ema)
    averages.copy(Choice(np.array([1, 1])))
    assert same(jax.device_get(averages.ema), [second, second])
    averages.ema = [first, second]
    averages.copy(Choice(np.array([0, 0]), np.full((2, 2), 0.5)))
    mean = jax.tree.map(lambda x, y: x * np.float32(0.5) + y * np.float32(0.5), first, second)
    assert same(jax.device_get(averages.ema), [mean, mean])


def test_before_any_update_means_are_those_of_fresh_actors(runs: Path) -> None:
    """At step 0 the EMA actors are the members, so both means are one."""
    (row, *_) = evaluations(run_to_end(start(runs, **IDLE)))
    members, ema = row["mean_actions"]["members"], row["mean_actions"]["ema"]
    assert row["step"] == 0
    assert members == ema


@pytest.mark.parametrize("mean_actions", ["auto", "on", "off"])
def test_the_mean_of_ema_actors_can_be_what_is_evaluated(runs: Path, mean_actions: str) -> None:
    """Training is the same; champion and mean change places in the log, and its file is the mean.

    With normalized observations and assessed policies, whose statistics are older than the run's.
    """
    same_run: dict[str, Any] = {"rule": "none", "eval_every": 30, "eval_episodes": 2}
    same_run |= {"normalize_observation": True, "assess": 1, "snapshots": 2, "steps": 120}
    usual = run_to_end(start(runs, name="usual", mean_actions="on", **same_run))
    trainer = start(runs, name="ema", eval_policy="ema", mean_actions=mean_actions, **same_run)
    directory = run_to_end(trainer)
    for one, other in zip(evaluations(usual), evaluations(directory), strict=True):
        assert other["returns"] == pytest.approx(one["mean_actions"]["ema"]["returns"], rel=1e-5)
        means, expected = other.get("mean_actions", {}), dict(one["mean_actions"])
        del expected["ema"]
        if mean_actions == "off":
            del expected["members"]
        else:
            expected["champion"] = {name: one[name] for name in ("mean", "std", "returns")}
        assert means == expected
        if "members" in other:
            assert other["members"] == one["members"]
    saved, kept = load(directory.policy_file), trainer.loop.policy(trainer.progress.champion)
    assert (len(saved.actors), len(kept.actors)) == (2, 1)
    assert saved.about["eval_policy"] == "ema"
    assert "kept_at" in kept.about
    assert "kept_at" not in saved.about
    assert not same(saved.normalizer, kept.normalizer)
    assert same(saved.normalizer, trainer.loop.experience.normalizer.statistics())
    observation = np.zeros(saved.observation_size, np.float32)
    expected = mean_action(trainer.loop.averaged(kept)["ema"])(observation)
    np.testing.assert_allclose(saved.act(observation), expected, rtol=1e-6)
    assert same(trainer.policy(0).actors, trainer.loop.policy(0).actors)


@pytest.mark.parametrize("algorithm", ["td3", "crossq", "td7", "sunrise"])
def test_training_is_the_same_whatever_is_evaluated(runs: Path, algorithm: str) -> None:
    """To the last bit: states, averages, replay and the log of training."""
    found: list[Any] = []
    for policy in ("champion", "ema"):
        settings: dict[str, Any] = {"algorithm": algorithm, "members": 2, "name": policy}
        settings |= {"mean_actions": "on", "eval_policy": policy, "eval_every": 40}
        trainer = start(runs, **settings)
        run = content(run_to_end(trainer))
        found.append((run["arrays"], [row for row in run["log"] if row["kind"] != "eval"]))
        own = len(trainer.loop.policy(0).actors)
        assert len(load(trainer.directory.policy_file).actors) == own * (1 + (policy == "ema"))
    (one, rows), (other, others) = found
    assert same(one, other)
    assert rows == others


def test_ema_is_evaluated_of_one_member_too(runs: Path) -> None:
    settings = {"algorithm": "td3", "steps": 60}
    usual = evaluations(run_to_end(start(runs, name="on", mean_actions="on", **settings)))
    found = evaluations(run_to_end(start(runs, name="ema", eval_policy="ema", **settings)))
    assert [row["mean"] for row in found] == [row["mean_actions"]["ema"]["mean"] for row in usual]
    assert all("mean_actions" not in row for row in found)


def test_snapshots_are_the_last_champions(runs: Path) -> None:
    trainer = start(runs, steps=120, eval_every=30, snapshots=2)
    seen: list[Policy] = []
    averaged = trainer.loop.averaged

    def watched(champion: Policy) -> Any:
        seen.append(champion)
        found = averaged(champion)
        kept = found["snapshots"]
        assert len(kept) == min(len(seen), 2)
        for mine, champion in zip(kept, seen[-2:], strict=False):
            assert same(mine.actors, champion.actors)
        return found

    trainer.loop.averaged = watched
    run_to_end(trainer)
    assert len(seen) == 5


def test_checkpoint_from_before_there_were_any_goes_on_and_says_so(runs: Path) -> None:
    directory = run_to_end(start(runs, steps=60, name="older"))
    arrays, table = storage.read(directory.state_file, "checkpoint")
    del table["averages"]
    arrays = {name: x for name, x in arrays.items() if not name.startswith("averages.")}
    storage.write(directory.state_file, "checkpoint", storage.Content(arrays, table))
    trainer = Trainer.resume(directory.path, steps=120)
    assert trainer.notes == ["averages: the checkpoint has none yet; they begin now"]
    run_to_end(trainer)
    assert all(ema is not None for ema in trainer.loop.averages.ema)

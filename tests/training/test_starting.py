"""Runs that start from earlier weights, stop at a return, and keep policies of the past."""

import shutil
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from scripted_runs import start
from short_runs import TINY, assert_same, log, run_to_end
from stopping import stop_at

from pacesetter import policy
from pacesetter.cli.main import main
from pacesetter.cli.show import state
from pacesetter.config import resolve
from pacesetter.envs import Recipe
from pacesetter.errors import UsageError
from pacesetter.evaluation import evaluate
from pacesetter.runs import RunDirectory
from pacesetter.settings.budget import Standing, standing
from pacesetter.study.bench.queue import Job, is_finished
from pacesetter.study.compare.gathering import gather
from pacesetter.training.trainer import Trainer

ENV = "Pendulum-v1"
SHORT: dict[str, Any] = {**TINY, "steps": 250, "eval_every": 250}


def trained(runs: Path, algorithm: str = "td3", env: str = ENV, **settings: Any) -> Trainer:
    trainer = Trainer(algorithm, env, runs=runs, **{**SHORT, **settings})
    run_to_end(trainer)
    return trainer


def same(a: Any, b: Any) -> bool:
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))


@pytest.mark.parametrize("algorithm", ["td3", "crossq-small", "sunrise", "trpo"])
def test_every_member_starts_with_the_champion_of_a_run(runs: Path, algorithm: str) -> None:
    """The whole state and the statistics of observations, of any algorithm."""
    small = {"hidden": (8,)} if algorithm == "sunrise" else {}
    tiny = {**SHORT, **small, "normalize_observation": True}
    if algorithm == "trpo":
        tiny = {"steps": 64, "parallel_envs": 2, "rollout_length": 32, "eval_every": 64,
                "eval_episodes": 1}  # fmt: skip
    if algorithm == "crossq-small":
        del tiny["hidden"]
    old = Trainer(algorithm, ENV, runs=runs, **tiny)
    run_to_end(old)
    members = {} if algorithm == "trpo" else {"members": 2}
    new = Trainer(
        algorithm, ENV, runs=runs, name="new", start_from=str(old.directory.path),
        **{**tiny, **members},
    )  # fmt: skip
    champion = old.loop.learners.states[old.progress.champion]
    assert all(same(champion, state) for state in new.loop.learners.states)
    assert same(old.loop.parts()["normalizer"].arrays(), new.loop.parts()["normalizer"].arrays())
    assert new.progress.step == 0
    run_to_end(new)


def test_it_is_the_champion_of_several_members(runs: Path) -> None:
    """Member 1, which has learned on its own since the selection at step 20."""
    old = start(runs, ([3], [5]), steps=30)
    run_to_end(old)
    assert old.progress.champion == 1
    other, champion = old.loop.learners.states
    assert not same(other.actor, champion.actor)
    new = start(runs, ([3], [5]), name="new", start_from=str(old.directory.path))
    assert all(same(champion, state) for state in new.loop.learners.states)
    new.close()


def test_the_ledger_starts_anew(runs: Path) -> None:
    """ME-TRPO counts in its state what its searches and fits have cost."""
    tiny: dict[str, Any] = {
        "steps": 500, "known": False, "hidden": (8,), "models": 2, "model_hidden": (8,),
        "model_rows": 1_000, "imagined_steps": 100, "horizon": 20, "policy_updates": 2,
        "check_every": 2, "rollout_length": 250, "eval_every": 500, "eval_episodes": 1,
    }  # fmt: skip
    old = Trainer("me-trpo", ENV, runs=runs, **tiny)
    run_to_end(old)
    assert old.ledger()["policy_updates"] > 0
    source = str(old.directory.path)
    new = Trainer("me-trpo", ENV, runs=runs, name="new", start_from=source, **tiny)
    assert {new.ledger()[name] for name in ("policy_updates", "model_epochs")} == {0}
    run_to_end(new)


@pytest.mark.parametrize("algorithm", ["td3", "sac", "ddpg"])
def test_a_policy_file_gives_the_actor(runs: Path, algorithm: str) -> None:
    """The new run acts as the file does, before it has learned anything."""
    old = trained(runs, algorithm)
    file = old.directory.policy_file
    new = Trainer(algorithm, ENV, runs=runs, name="new", start_from=str(file), **SHORT)
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    assert np.array_equal(new.policy()(observations), policy.load(file)(observations))
    run_to_end(new)


def test_a_run_does_not_need_its_source_again(runs: Path) -> None:
    """Resumed without it, the run equals one that was never stopped."""
    old = trained(runs).directory.path
    for name in ("whole", "cut"):
        new = Trainer("td3", ENV, runs=runs / name, start_from=str(old), name="new", **SHORT)
        if name == "whole":
            whole = run_to_end(new)
        else:
            stop_at(new, 150)
    shutil.rmtree(old)
    assert_same(whole, run_to_end(Trainer.resume(new.directory.path)))


def test_a_run_that_was_killed_before_its_first_checkpoint_starts_there_again(runs: Path) -> None:
    old = trained(runs).directory.path
    new = Trainer("td3", ENV, runs=runs, start_from=str(old), name="new", **SHORT)
    policy = new.policy()
    new.close()
    new.directory.state_file.unlink()
    again = Trainer.resume(new.directory.path)
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    assert np.array_equal(again.policy()(observations), policy(observations))
    again.close()


def test_policies_that_are_kept_are_those_of_the_log(runs: Path) -> None:
    """Not of evaluations that a killed run made after its checkpoint; a user's files stay."""
    settings = {**SHORT, "steps": 300, "eval_every": 100, "checkpoint_every": 3600, "keep": 1}
    trainer = Trainer("td3", ENV, runs=runs, **settings)
    trainer.save = lambda: None
    for report in trainer:
        if report.kind == "eval" and report.step == 300:
            break
    folder = trainer.directory.policies
    mine = folder / "step-100-best.safetensors"
    mine.touch()
    assert (folder / "step-300.safetensors").exists()
    run_to_end(Trainer.resume(trainer.directory.path, steps=250))
    assert {file.name for file in folder.iterdir()} == {mine.name, "step-250.safetensors"}


def test_what_does_not_fit_is_refused_and_leaves_nothing(runs: Path, tmp_path: Path) -> None:
    old = trained(runs)
    file, run = old.directory.policy_file, old.directory.path
    scaled = trained(runs, name="scaled", normalize_observation=True).directory.policy_file
    normed = trained(runs, name="normed", actor_layer_norm=True).directory.path
    pair = trained(runs, name="pair", members=2, eval_policy="ema").directory.policy_file
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(file.read_bytes()[:-7])
    for source, changes, words in [
        (run, {"hidden": (8, 8)}, "does not fit this run: actor.0.bias is"),
        (normed, {}, r"does not fit this run: it also has actor\.0\.offset"),
        (run, {"algorithm": "sac"}, "has algorithm=td3, this run sac"),
        (run, {"env": "Hopper-v5"}, "does not fit this run"),
        (run, {"normalize_observation": True}, "has normalize_observation=False, this run True"),
        (file, {"hidden": (8, 8)}, "does not fit this run: its layers have shapes"),
        (file, {"algorithm": "crossq-small"}, "CrossQ cannot take the actor of a policy file"),
        (file, {"algorithm": "td7-small"}, "TD7 cannot take the actor of a policy file"),
        (scaled, {}, "acts on normalized observations"),
        (file, {"normalize_observation": True}, "acts on the task's own observations"),
        (pair, {}, "averages 2 actors, and a member has one"),
        (damaged, {}, "damaged"),
        (tmp_path / "none.safetensors", {}, "none.safetensors"),
        ("nowhere", {}, "'nowhere' not found"),
    ]:
        settings = {**SHORT, **changes}
        algorithm, env = settings.pop("algorithm", "td3"), settings.pop("env", ENV)
        if algorithm in ("crossq-small", "td7-small"):
            del settings["hidden"]
        with pytest.raises(UsageError, match=words):
            Trainer(algorithm, env, runs=runs, name="new", start_from=str(source), **settings)
        assert not list(runs.glob("*/new"))


class Watched(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A task that knows how many of its kind are open."""

    open = 0

    def __init__(self) -> None:
        super().__init__(gymnasium.make("Pendulum-v1"))
        Watched.open += 1

    def close(self) -> None:
        super().close()
        Watched.open -= 1


def test_a_trainer_that_cannot_start_closes_its_envs(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Watched, "open", 0)
    with pytest.raises(UsageError, match="'nowhere' not found"):
        Trainer("td3", Watched, runs=runs, start_from="nowhere", **SHORT)
    with pytest.raises(UsageError, match="actor_observes"):
        Trainer("td3", Watched, runs=runs, actor_observes="0:99", **SHORT)
    assert Watched.open == 0
    old = Trainer("td3", Watched, runs=runs, **SHORT)
    with pytest.raises(UsageError, match="in use"):
        Trainer.resume(old.directory.path, env=Watched)
    old.close()
    old.directory.state_file.write_bytes(b"")
    with pytest.raises(UsageError, match="damaged"):
        Trainer.resume(old.directory.path, env=Watched)
    assert Watched.open == 0


# Stop at a return.


def test_a_run_stops_at_the_evaluation_that_reaches_the_return(runs: Path) -> None:
    whole = trained(runs, name="whole", steps=1000, eval_every=100)
    means = [row["mean"] for row in log(whole.directory) if row["kind"] == "eval"][1:]
    goal = sorted(means)[len(means) // 2]
    first = next(i for i, mean in enumerate(means) if mean >= goal)
    short = trained(runs, name="short", steps=1000, eval_every=100, stop_at=goal)
    rows = [row for row in log(short.directory) if row["kind"] == "eval"]
    assert short.finished
    assert short.progress.step == rows[-1]["step"] == (first + 1) * 100
    assert [row["mean"] for row in rows[1:]] == means[: first + 1]
    assert is_finished(Job(short.config, short.directory, []))
    (seen,) = gather([short.directory.path]).runs
    assert seen.finished


def test_it_goes_on_with_a_higher_return(runs: Path) -> None:
    short = trained(runs, steps=400, eval_every=100, stop_at=-1e9)
    assert short.progress.step == 100
    more = Trainer.resume(short.directory.path, stop_at=1e9)
    run_to_end(more)
    assert more.progress.step == 400
    assert more.directory.config().run.stop_at == 1e9


def test_a_run_stops_after_evaluations_without_a_best_one(runs: Path) -> None:
    settings: dict[str, Any] = {"steps": 2000, "eval_every": 100, "warmup": 300}
    whole = trained(runs, name="whole", **settings)
    rows = [row for row in log(whole.directory) if row["kind"] == "eval" and row["step"] > 0]
    means = [row["mean"] for row in rows]
    learning = [n for n, row in enumerate(rows) if row["updates"] > 0]
    bad = [n for n in learning if means[n] <= max(means[:n])]
    ends = next(n for n in bad if n - 1 in bad)  # the second one in a row
    assert ends < len(means) - 1
    short = trained(runs, name="short", stop_patience=2, **settings)
    assert short.finished
    assert short.progress.step == (ends + 1) * 100
    assert [r["mean"] for r in log(short.directory) if r["kind"] == "eval"][1:] == means[: ends + 1]
    assert is_finished(Job(short.config, short.directory, []))
    (seen,), *_ = gather([short.directory.path])
    assert seen.finished
    assert state(short.directory)["state"] == "finished"
    more = Trainer.resume(short.directory.path, stop_patience=1000)
    run_to_end(more)
    assert [r["mean"] for r in log(more.directory) if r["kind"] == "eval"][1:] == means


def test_a_member_that_the_run_has_not_is_refused(runs: Path) -> None:
    trainer = Trainer("td3", ENV, runs=runs, members=2, **SHORT)
    assert trainer.policy(1).about["step"] == 0
    for member in (-1, 2):
        with pytest.raises(UsageError, match=f"member: must be from 0 to 1, got {member}"):
            trainer.policy(member)
    trainer.close()


def test_keywords_beside_a_recipe_are_refused() -> None:
    with pytest.raises(UsageError, match="env_kwargs: a Recipe has its own"):
        evaluate(None, Recipe(ENV), 1, env_kwargs={"g": 9.0})
    assert len(evaluate(None, Recipe(ENV, {"g": 9.0}), 1).returns) == 1


def test_new_limits_may_be_typed(runs: Path) -> None:
    short = trained(runs, steps=400, eval_every=100, stop_at=-1e9, stop_patience=50)
    words = ["--stop-at", "1e9", "--stop-patience", "60", "--runs", str(runs), "-q"]
    assert main(["resume", str(short.directory.path), *words]) == 0
    run = short.directory.config().run
    assert (run.stop_at, run.stop_patience) == (1e9, 60)
    assert log(short.directory)[-1]["step"] == 400


def test_evaluations_before_the_first_update_cannot_make_progress() -> None:
    before = [(0, 9.0, 0), (100, 1.0, 0), (200, 1.0, 0), (300, 0.0, 0)]
    assert standing(before) == Standing(1.0, 0)
    assert standing([*before, (400, 0.5, 10), (500, 1.0, 20)]) == Standing(1.0, 2)
    assert standing([*before, (400, 0.5, 10), (500, 1.5, 20)]) == Standing(1.5, 0)


# Keep policies of the past.


def test_the_last_policies_are_kept(runs: Path) -> None:
    run = trained(runs, steps=500, eval_every=100, keep=3).directory
    files = sorted((run.path / "policies").iterdir())
    assert [file.name for file in files] == [f"step-{step}.safetensors" for step in (300, 400, 500)]
    assert [policy.load(file).about["step"] for file in files] == [300, 400, 500]
    assert files[-1].read_bytes() == run.policy_file.read_bytes()


def test_none_are_kept_by_default(runs: Path) -> None:
    assert not (trained(runs).directory.path / "policies").exists()


def test_steps_are_sorted_as_numbers(runs: Path) -> None:
    """90, 100, 110: as words 110 would come before 90."""
    run: RunDirectory = trained(runs, steps=110, warmup=10, eval_every=10, keep=3).directory
    assert {file.stem for file in (run.path / "policies").iterdir()} == {
        "step-90", "step-100", "step-110"
    }  # fmt: skip


def test_the_scale_of_rewards_goes_with_the_critics(runs: Path) -> None:
    old = trained(runs, normalize_reward=True)
    source = str(old.directory.path)
    new = Trainer(
        "td3", ENV, runs=runs, name="new", start_from=source, **SHORT, normalize_reward=True
    )
    before, now = old.loop.experience.return_scale, new.loop.experience.return_scale
    assert now.deviation == before.deviation != 1
    assert not now.running.any()
    new.close()
    with pytest.raises(UsageError, match="has normalize_reward=True, this run False"):
        Trainer("td3", ENV, runs=runs, name="other", start_from=source, **SHORT)


@pytest.mark.parametrize("rule", ["best", "none"])
def test_a_run_that_stops_at_a_return_has_logged_every_episode(runs: Path, rule: str) -> None:
    short = trained(
        runs, "multi-td3", steps=2000, eval_every=1000, stop_at=-1e9, rule=rule,
        env_kwargs={"max_episode_steps": 50},
    )  # fmt: skip
    ended = [row["episodes_ended"] for row in log(short.directory) if row["kind"] == "train"]
    assert sum(map(len, ended)) == short.progress.episodes > 0
    assert not short.progress.ended
    assert [row["step"] for row in log(short.directory) if row["kind"] == "eval"][-1] < 2000


def test_refuses_an_actor_of_other_functions(runs: Path) -> None:
    """The shapes fit, but a tanh network's weights mean something else with ReLUs."""
    found = policy.Policy(
        [[{"kernel": np.ones((3, 1), np.float32), "bias": np.zeros(1, np.float32)}]],
        "tanh", "clip", -2 * np.ones(1, np.float32), 2 * np.ones(1, np.float32), about={"env": ENV},
    )  # fmt: skip
    found.save(runs.parent / "other.safetensors")
    with pytest.raises(UsageError, match="has an actor of tanh and clip, this run's has relu and"):
        Trainer("td3", ENV, runs=runs, start_from=str(runs.parent / "other.safetensors"), **SHORT)


def test_refuses_a_wrapped_task_whose_reward_is_known() -> None:
    with pytest.raises(UsageError, match="wrap: --known takes the reward of the plain task"):
        resolve("me-trpo", "Swimmer-v5", {"wrap": ("odd_envs:Doubled",)})
    resolve("me-trpo", "Swimmer-v5", {"wrap": ("odd_envs:Doubled",), "known": False})

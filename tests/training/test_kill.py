"""Runs that are killed, asked to stop, or fail by a NaN lose nothing that a checkpoint holds."""

import re
import signal
import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import broken_envs
import jax
import numpy as np
import pytest
from broken_envs import Late
from short_runs import TINY, assert_same, run_to_end, run_to_step
from stopping import (
    PATIENCE,
    RING,
    has_saved_beyond,
    kill_and_resume,
    launch,
    litter,
    only_run,
    saved_step,
    training,
    wait_for,
)

from pacesetter import storage
from pacesetter.cli.main import main
from pacesetter.errors import TaskError, TrainingError
from pacesetter.policy import Policy
from pacesetter.process import stopping
from pacesetter.replay import buffer
from pacesetter.runs import RunDirectory, find_all
from pacesetter.training import checkpoint
from pacesetter.training.trainer import Trainer

FLAGS = ["--hidden", "16", "16", "--batch-size", "16", "--warmup", "200", "--replay-size", "300"]
FLAGS += ["--eval-episodes", "1", "--eval-every", "1000", "--checkpoint-every", "0.3s", "-q"]
KILLED = {
    "HalfCheetah-v5": ["train", "td3", "HalfCheetah-v5", "--steps", "3000", *FLAGS],
    "Ant-v5": ["train", "multi-td3", "Ant-v5", "--steps", "1600", *FLAGS],
}


@pytest.fixture(autouse=True, scope="module")
def small_ring() -> Iterator[None]:
    """This process's ring is as small as the subprocesses'."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in RING.items():
            patch.setattr(buffer, name, value)
        yield


Undisturbed = Callable[[str], RunDirectory]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """The run of KILLED on a task that was left alone, made once."""

    @cache
    def make(env: str) -> RunDirectory:
        runs = tmp_path_factory.mktemp("whole")
        assert main([*KILLED[env], "--runs", str(runs)]) == 0
        return only_run(runs)

    return make


@pytest.mark.parametrize("env", ["HalfCheetah-v5", pytest.param("Ant-v5", marks=pytest.mark.slow)])
def test_killed_run_equals_undisturbed(env: str, tmp_path: Path, undisturbed: Undisturbed) -> None:
    assert_same(undisturbed(env), kill_and_resume(KILLED[env], tmp_path, kills=3, seed=len(env)))


@pytest.mark.slow
@pytest.mark.parametrize("env", KILLED)
def test_run_killed_often_equals_undisturbed(env: str, tmp_path: Path) -> None:
    words = [*KILLED[env], "--steps", "120000"]
    directory = kill_and_resume(words, tmp_path, kills=40, seed=3)
    assert main([*words, "--runs", str(tmp_path / "whole")]) == 0
    assert_same(only_run(tmp_path / "whole"), directory)


@pytest.mark.slow
def test_killed_run_with_models_equals_undisturbed(tmp_path: Path) -> None:
    """STEVE's models, their optimiser and the rows that each learns from go on as they were."""
    words = ["train", "multi-steve-td3", "Hopper-v5", "--steps", "4000", *FLAGS]
    words += ["--model-hidden", "8", "--head-hidden", "8", "--critic-members", "2"]
    killed = kill_and_resume(words, tmp_path, kills=3, seed=1)
    assert main([*words, "--runs", str(tmp_path / "whole")]) == 0
    assert_same(only_run(tmp_path / "whole"), killed)


@pytest.mark.slow
def test_killed_run_of_members_that_differ_equals_undisturbed(tmp_path: Path) -> None:
    """Their settings, perturbed by pbt, and their EMA actors go on as they were."""
    words = ["train", "multi-td3", "Hopper-v5", "--steps", "4000", *FLAGS, "--rule", "pbt"]
    words += ["--members", "4", "--select-window", "2", "--snapshots", "2"]
    words += ["--vary", "critic-learning-rate=1e-4,1e-3", "--vary", "exploration_noise=0.1,0.3"]
    killed = kill_and_resume(words, tmp_path, kills=3, seed=2)
    assert main([*words, "--runs", str(tmp_path / "whole")]) == 0
    assert_same(only_run(tmp_path / "whole"), killed)
    assert any(row["kind"] == "select" and "scales" in row for row in killed.rows())


# Signals.


ENDS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


def test_signals_save_and_end(tmp_path: Path, undisturbed: Undisturbed) -> None:
    """Each signal in turn, then on to the end: nothing is lost, nothing repeated."""
    runs, words = tmp_path / "stopped", KILLED["HalfCheetah-v5"]
    steps = [0]
    for number, code in ENDS.items():
        process = launch(words, runs)
        wait_for(partial(training, runs), process)
        directory = only_run(runs)
        wait_for(partial(has_saved_beyond, directory, steps[-1]), process)
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE)
        assert (process.returncode, err) == (code, "")
        assert f"saved; go on with `pacesetter resume {directory.path}`" in out
        steps.append(saved_step(directory))
        said = re.search(r": ([\d,]+) steps", out)
        assert said
        assert int(said[1].replace(",", "")) == steps[-1] > steps[-2]
        assert not directory.in_use()
        assert litter(directory) == []
        words = ["resume", str(directory.path)]
    assert steps[-1] < 3000
    assert_same(undisturbed("HalfCheetah-v5"), run_to_end(Trainer.resume(directory.path)))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_signal_before_there_is_a_run(number: signal.Signals, tmp_path: Path) -> None:
    """While JAX is imported, which a signal must neither break nor lose: the run saves and ends."""
    process = launch(KILLED["HalfCheetah-v5"], tmp_path, "-m", "pacesetter")
    libraries = Path(f"/proc/{process.pid}/maps")
    wait_for(lambda: "jaxlib" in libraries.read_text(), process)
    assert not any(find_all(tmp_path))
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (ENDS[number], "")
    assert f"saved; go on with `pacesetter resume {only_run(tmp_path).path}`" in out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_second_signal_ends_at_once(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first waits for a task that hangs, the second for nothing; resume goes on."""
    monkeypatch.setenv("PYTHONPATH", str(Path(broken_envs.__file__).parent))
    words = ["train", "td3", "broken_envs:Hangs-v0", "--steps", "500", "--no-renew-env", *FLAGS]
    process = launch([*words, f"--env.mark={tmp_path / 'mark'}"], tmp_path)
    wait_for((tmp_path / "mark").exists, process)
    process.send_signal(number)
    time.sleep(0.5)
    assert process.poll() is None
    before = time.monotonic()
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert time.monotonic() - before < 30  # of a task that never comes back
    assert (process.returncode, out, err) == (128 + number, "", "")
    directory = only_run(tmp_path)
    assert not directory.in_use()
    trainer = Trainer.resume(directory.path)
    (kept,) = trainer.notes
    assert "kept from one episode to the next" in kept
    trainer.close()


def stopping_act(trainer: Trainer, at: int) -> Callable[[Policy, Any], Any]:
    """`Policy.act`, which asks for the end within an evaluation: as the mean actions are played."""
    act, calls = Policy.act, 0

    def act_and_count(self: Policy, observation: Any) -> Any:
        nonlocal calls
        calls += trainer.progress.step == at
        if calls == 250:  # the champion's trial took the first hundred
            trainer.stop()
        return act(self, observation)

    return act_and_count


def test_stop_within_an_evaluation(tmp_path: Path) -> None:
    """It is given up at once, however long it is; the resumed run makes it, and all else once."""
    settings: dict[str, Any] = {"eval_every": 300, "mean_actions": "on", "snapshots": 2}
    whole = run_to_end(late(tmp_path / "whole", **settings))
    trainer = late(tmp_path / "stopped", **settings)
    for at in (0, 300, 900):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Policy, "act", stopping_act(trainer, at))
            run_to_end(trainer)
        assert (trainer.progress.step, trainer.finished) == (at, False)
        trainer = Trainer.resume(trainer.directory.path)
    assert_same(whole, run_to_end(trainer))


# Faults at a late step.

FAULTS = {
    "nan": "observation: must be finite and at most .* in size, number 2 is nan",
    "reward": "reward: must be finite and at most .* in size, got -inf",
    "error": "a bolt fell out",
    "exit": "step: failed: SystemExit: 0",
    "os._exit": r"step: failed: SystemExit: os._exit\(0\)",
    "interrupt": "step: failed: KeyboardInterrupt",
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """The run of `late` when nothing fails."""
    return run_to_end(late(tmp_path_factory.mktemp("whole")))


def late(runs: Path, **settings: Any) -> Trainer:
    """A run of two members on a task that may fail; it saves about every 20 ms."""
    settings = {**TINY, "steps": 900, "checkpoint_every": 0.02, "members": 2, **settings}
    settings["renew_env"] = False  # its faults count the steps of an env's whole life
    return Trainer("td3", "broken_envs:Late-v0", runs=runs, **settings)


def test_a_tick_that_a_fault_broke_off_ends_before_an_evaluation(
    tmp_path: Path, disarmed: None
) -> None:
    """With three members, step 100 lies within a tick: its evaluation comes at 102."""
    settings: dict[str, Any] = {"members": 3, "eval_every": 100, "steps": 300}
    whole = run_to_end(late(tmp_path / "whole", **settings))
    Late.arm("error", victim=1, at=34)
    trainer = late(tmp_path / "faulty", **settings)
    with pytest.raises(TaskError, match="member 1, step 100"):
        run_to_end(trainer)
    Late.disarm()
    assert_same(whole, run_to_end(Trainer.resume(trainer.directory.path)))


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_of_env_stops_the_run(
    fault: str,
    whole: RunDirectory,
    tmp_path: Path,
    disarmed: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line names member and step, and all before is saved; without the fault the run goes on
    as if it had not been.
    """
    # Member 1 acts second in each tick; its own 300th step comes when the run has made 599.
    Late.arm(fault, victim=1, at=300)
    trainer = late(tmp_path / "faulty")
    fails = pytest.raises(TaskError, match=f"member 1, step 599: .*{FAULTS[fault]}")
    with stopping(trainer.stop), fails:  # else pytest has KeyboardInterrupt
        run_to_end(trainer)
    directory = trainer.directory
    assert not directory.in_use()
    assert saved_step(directory) == 599  # within a tick, so only after the fault
    Late.arm(fault, victim=1, at=saved_step(directory) // 2 % broken_envs.EPISODE + 5)
    assert main(["resume", str(directory.path), "-q"]) == 1
    kept, error = capsys.readouterr().err.splitlines()
    assert "kept from one episode to the next" in kept
    assert re.fullmatch(r"pacesetter: stopped: member 1, step \d+: .+", error), error
    Late.disarm()
    run_to_end(Trainer.resume(directory.path))
    assert_same(whole, directory)


def test_task_that_hangs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its step is named, and all before it is saved."""
    words = ["train", "td3", "broken_envs:Hangs-v0", "--steps", "500", "--no-renew-env", *FLAGS]
    words += [f"--env.mark={tmp_path / 'mark'}", "--env-timeout", "1s", "--runs", str(tmp_path)]
    assert main(words) == 1
    error = capsys.readouterr().err
    assert error == (
        "pacesetter: stopped: member 0, step 148: broken_envs:Hangs-v0: step: failed: "
        "it has not returned after 1 s, the limit of --env-timeout\n"
    )
    assert saved_step(only_run(tmp_path)) == 148


def test_run_that_gets_a_limit_when_it_is_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that hangs and was killed goes on with `--env-timeout`, which config.json keeps."""
    settings: dict[str, Any] = {**TINY, "steps": 500, "renew_env": False, "runs": tmp_path}
    settings["env_kwargs"] = {"mark": str(tmp_path / "mark")}
    directory = run_to_step(Trainer("td3", "broken_envs:Hangs-v0", **settings), 50)
    again = ["resume", str(directory.path), "-q", "--allow=broken_envs:Hangs-v0"]
    assert main([*again, "--env-timeout", "soon"]) == 2
    assert "env_timeout" in capsys.readouterr().err
    device = ["--device", "cpu"]
    assert main([*again, "--env-timeout", "1s", "--checkpoint-every", "5m", *device]) == 1
    assert "the limit of --env-timeout" in capsys.readouterr().err
    assert directory.settings()["env_timeout"] == 1
    assert directory.settings()["checkpoint_every"] == 300
    assert directory.settings()["device"] == "cpu"
    assert saved_step(directory) == 148  # a step of its life was the test at the start


def test_fault_in_an_evaluation(tmp_path: Path, disarmed: None) -> None:
    """The env of evaluations is number 2; the resumed run makes the evaluation again."""
    whole = run_to_end(late(tmp_path / "whole", eval_every=300, checkpoint_every=3600))
    Late.arm("nan", victim=2, at=150 + 3 * broken_envs.EPISODE)
    trainer = late(tmp_path / "faulty", eval_every=300, checkpoint_every=3600)
    with pytest.raises(TaskError, match=r"member \d, step 300: .*observation"):
        run_to_end(trainer)
    assert not trainer.directory.in_use()
    assert saved_step(trainer.directory) == 300
    Late.disarm()
    assert_same(whole, run_to_end(Trainer.resume(trainer.directory.path)))


def poison(trainer: Trainer, field: str, member: int, value: float) -> None:
    """Put a number into the first array of a part of one member's state."""
    states = trainer.loop.learners.states
    leaves, structure = jax.tree.flatten(getattr(states[member], field))
    place = next(i for i, leaf in enumerate(leaves) if leaf.dtype == np.float32)
    leaves[place] = leaves[place].at[(0,) * leaves[place].ndim].set(value)
    part = jax.tree.unflatten(structure, leaves)
    states[member] = states[member]._replace(**{field: part})


def at_step(trainer: Trainer, step: int, do: Callable[[], object]) -> None:
    """Do something when the run has made so many steps."""
    tick = trainer.loop.tick

    def tick_and_do() -> Any:
        selection = tick()
        if trainer.progress.step == step:
            do()
        return selection

    trainer.loop.tick = tick_and_do


PARTS = ("actor", "critic", "target_critic", "actor_opt_state", "critic_opt_state")


FAULTY = [*((part, np.nan) for part in PARTS), ("critic", np.inf)]


@pytest.mark.parametrize(("part", "value"), FAULTY)
def test_fault_in_a_weight(part: str, value: float, tmp_path: Path, disarmed: None) -> None:
    """Found within a few steps, named, and never in a file."""
    trainer = late(tmp_path)
    at_step(trainer, 600, lambda: poison(trainer, part, 1, value))
    with pytest.raises(TrainingError, match=r"member 1, step 6(0\d|1\d): ") as fault:
        run_to_end(trainer)
    assert "\n" not in str(fault.value)
    arrays, _ = storage.read(trainer.directory.state_file, "checkpoint")
    assert all(np.isfinite(array).all() for array in arrays.values())
    assert 0 < saved_step(trainer.directory) <= 600


def test_fault_in_a_loss(
    whole: RunDirectory, tmp_path: Path, disarmed: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss is named, with its member; the run goes on from before it, exactly."""
    trainer = late(tmp_path / "faulty")
    compiled = trainer.loop.learners.compiled
    update = compiled.update

    def broken(state: Any, member: int, inputs: Any) -> Any:
        result = update(state, member, inputs)
        losses = np.array(result.losses)
        if trainer.progress.step == 600 and member == 1:
            losses[0] = np.inf
        return result._replace(losses=losses)

    monkeypatch.setattr(compiled, "update", broken)
    with pytest.raises(TrainingError, match=r"^member 1, step 600: actor_loss is inf"):
        run_to_end(trainer)
    resumed = run_to_end(Trainer.resume(trainer.directory.path))
    assert_same(whole, resumed)


@pytest.mark.parametrize("algorithm", ["td3", "trpo"])
def test_the_first_fault_is_the_one_that_is_told(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A simulator that crashed cannot be closed either; the other envs are closed all the same."""
    few: dict[str, Any] = {**TINY, "members": 3}
    if algorithm == "trpo":
        few = {"parallel_envs": 3, "rollout_length": 50, "eval_every": 300, "eval_episodes": 1}
    trainer = Trainer(algorithm, "broken_envs:Probe-v0", runs=tmp_path, steps=300, **few)
    closed: list[Any] = []

    def crash(self: Any, action: Any) -> Any:
        raise RuntimeError("a bolt fell out")

    def close(self: Any) -> None:
        closed.append(self)
        raise RuntimeError("the door is stuck")

    monkeypatch.setattr(broken_envs.Probe, "step", crash)
    monkeypatch.setattr(broken_envs.Probe, "close", close)
    with pytest.raises(TaskError, match=r"step 0: .*a bolt fell out"):
        run_to_end(trainer)
    assert len(closed) >= 3
    assert not trainer.directory.in_use()


def test_a_break_that_cannot_save_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python passes over what is raised when a loop is left, so a line says it."""
    trainer = Trainer("td3", "broken_envs:Probe-v0", runs=tmp_path, **TINY, steps=300)

    def full(*given: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "save", full)
    for _ in trainer:
        break
    assert capsys.readouterr().err == (
        "pacesetter: not saved: OSError: [Errno 28] No space left on device\n"
    )

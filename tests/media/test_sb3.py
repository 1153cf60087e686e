"""What Stable-Baselines3 calls a model: `predict` with its arguments, shapes and units."""

import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from policies import untrained

from pacesetter.envs import Recipe
from pacesetter.errors import UsageError
from pacesetter.media.export import export
from pacesetter.media.sb3 import SB3Policy
from pacesetter.policy import Policy


@pytest.fixture
def pendulum() -> Policy:
    return untrained("Pendulum-v1", env_kwargs={"max_episode_steps": 10, "g": 9.0})


def test_predict_is_the_policy_for_one_and_for_many(
    pendulum: Policy, rng: np.random.Generator
) -> None:
    model, many = SB3Policy(pendulum), rng.normal(size=(5, 3)).astype(np.float32)
    actions, state = model.predict(many, state=None, episode_start=np.ones(5), deterministic=True)
    assert actions.shape == (5, 1)
    assert state is None
    assert np.array_equal(actions, pendulum(many))
    action, state = model.predict(many[2], ("kept",), deterministic=False)
    assert action.shape == (1,)
    assert np.array_equal(action, pendulum(many[2]))
    assert state == ("kept",)
    assert np.abs(actions).max() > 1  # torque in the env's units, of +-2


def test_script_gives_the_model_and_runs(
    pendulum: Policy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "pendulum.py"
    assert "pendulum.safetensors" in export(pendulum, "sb3", path)
    observation = np.array([0.1, 0.2, 0.3], np.float32)
    model = runpy.run_path(str(path))["model"]
    assert np.array_equal(model.predict(observation)[0], pendulum(observation))
    if "stable_baselines3" not in sys.modules and not _has_sb3():
        _stand_in(monkeypatch)
    runpy.run_path(str(path), run_name="__main__")
    assert "over 10 episodes" in capsys.readouterr().out


def _has_sb3() -> bool:
    from importlib.util import find_spec

    return find_spec("stable_baselines3") is not None


def _stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two names that the script takes from SB3, for where it is not installed."""

    def evaluate_policy(model: Any, env: Any, n_eval_episodes: int) -> tuple[float, float]:
        assert env.unwrapped.g == 9.0
        returns = []
        for _ in range(n_eval_episodes):
            (observation, _), total, ended = env.reset(), 0.0, False
            while not ended:
                action, _ = model.predict(observation[None], deterministic=True)
                observation, reward, over, cut, _ = env.step(action[0])
                total, ended = total + reward, over or cut
            returns.append(total)
        return float(np.mean(returns)), float(np.std(returns))

    names = {
        "stable_baselines3": {},
        "stable_baselines3.common": {},
        "stable_baselines3.common.evaluation": {"evaluate_policy": evaluate_policy},
        "stable_baselines3.common.monitor": {"Monitor": gymnasium.Wrapper},
    }
    for name, content in names.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)


def test_evaluate_policy_of_sb3_accepts_it(pendulum: Policy) -> None:
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    from stable_baselines3.common.monitor import Monitor  # pyright: ignore[reportMissingImports]

    env = Monitor(gymnasium.make("Pendulum-v1", max_episode_steps=10))
    returns, lengths = evaluation.evaluate_policy(
        SB3Policy(pendulum), env, n_eval_episodes=3, return_episode_rewards=True
    )
    assert lengths == [10, 10, 10]
    assert all(-200 < total < 0 for total in returns)


def test_bad_input_is_one_line(pendulum: Policy, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"must end in \.py"):
        export(pendulum, "sb3", tmp_path / "pendulum.zip")
    (tmp_path / "pendulum.safetensors").write_text("mine")
    with pytest.raises(UsageError, match=r"exists; give pendulum\.py another name"):
        export(pendulum, "sb3", tmp_path / "pendulum.py")
    assert (tmp_path / "pendulum.safetensors").read_text() == "mine"
    with pytest.raises(UsageError, match="cannot write"):
        export(pendulum, "sb3", tmp_path / "none" / "pendulum.py")


def test_a_policy_file_cannot_put_code_into_the_script(tmp_path: Path) -> None:
    hostile = untrained("Pendulum-v1")
    hostile.about["env"] = "x'); raise SystemExit('run') #"
    export(hostile, "sb3", tmp_path / "one.py")
    assert repr(hostile.about["env"]) in (tmp_path / "one.py").read_text()
    hostile.about["env"] = "os:Pendulum-v1"
    with pytest.raises(UsageError, match="allow it with --allow"):
        export(hostile, "sb3", tmp_path / "two.py")


def test_script_makes_the_task_that_was_asked_for(pendulum: Policy, tmp_path: Path) -> None:
    path = tmp_path / "pendulum.py"
    export(pendulum, "sb3", path, env="Pendulum-v1", env_kwargs={"g": 1.0})
    assert "Recipe('Pendulum-v1', {'g': 1.0}).make()" in path.read_text()
    wrapped = Recipe("Pendulum-v1", {}, ("my_mod:Half",))
    export(pendulum, "sb3", tmp_path / "other.py", env=wrapped)
    assert (
        "Recipe('Pendulum-v1', {}, ('my_mod:Half',)).make()" in (tmp_path / "other.py").read_text()
    )


def test_script_with_an_infinite_keyword_runs(
    pendulum: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "pendulum.py"
    export(pendulum, "sb3", path, env="Pendulum-v1", env_kwargs={"g": float("inf")})
    made: list[Any] = []

    def make(recipe: Recipe) -> Any:
        made.append(recipe.kwargs)
        return gymnasium.make("Pendulum-v1", g=9.0, max_episode_steps=10)

    monkeypatch.setattr(Recipe, "make", make)
    if not _has_sb3():
        _stand_in(monkeypatch)
    runpy.run_path(str(path), run_name="__main__")
    assert made == [{"g": float("inf")}]


@pytest.mark.parametrize("env", ["odd_envs:Goal-v0", "pacesetter/Ant111-v4"])
def test_script_makes_tasks_that_gymnasium_alone_would_not(tmp_path: Path, env: str) -> None:
    """One with Dict observations, and one of pacesetter's own, in a process of its own."""
    path = tmp_path / "task.py"
    export(untrained(env), "sb3", path, env=env)
    (line,) = [line.strip() for line in path.read_text().splitlines() if "Monitor(" in line]
    code = (
        "from task import model; from pacesetter.envs import Recipe; Monitor = lambda env: env; "
        f"{line}; env.step(model.predict(env.reset(seed=0)[0])[0])"
    )
    helpers = str(Path(__file__).parents[1] / "helpers")
    paths = {"PYTHONPATH": os.pathsep.join([str(tmp_path), helpers])}
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | paths)


def test_script_is_refused_what_it_cannot_make(tmp_path: Path) -> None:
    made = untrained("Pendulum-v1")
    made.about["wrap"] = ["os:Half"]
    with pytest.raises(UsageError, match=r"wrap: .*allow it with --allow os:Half"):
        export(made, "sb3", tmp_path / "one.py")
    made.about.update(wrap=[], env="function/env")
    with pytest.raises(UsageError, match="given as a function"):
        export(made, "sb3", tmp_path / "two.py")

"""A data set holds what the env gave and took, to the last bit."""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from policies import untrained

from pacesetter.errors import UsageError
from pacesetter.evaluation import enter, evaluate
from pacesetter.media.export import export
from pacesetter.policy import Policy, to_env

minari = pytest.importorskip("minari", reason="needs the extra minari")
pytest.importorskip("h5py", reason="needs the extra minari")


@pytest.fixture
def pendulum() -> Policy:
    """Its torque is +-2, its observations are float32, and its episodes are cut at 30 steps."""
    return untrained("Pendulum-v1", algorithm="td3", env_kwargs={"max_episode_steps": 30})


def test_data_set_loads_back_equal(
    pendulum: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = export(pendulum, "minari", tmp_path / "pendulum-td3-v0", episodes=3, seed=4)
    assert "3 episodes, return -" in said
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = minari.load_dataset("pendulum-td3-v0")
    assert (data.total_episodes, data.total_steps) == (3, 90)
    assert data.spec.env_spec.id == "Pendulum-v1"
    assert data.storage.metadata["algorithm_name"] == "td3"
    world = enter(pendulum, None, 4)
    for number, episode in enumerate(data.iterate_episodes()):
        observation, given, actions, rewards = world.reset(number), [world.given], [], []
        for _ in range(30):
            action = pendulum.act(observation)
            step = world.step(action)
            observation = step.observation
            given.append(world.given)
            actions.append(to_env(action, world.low, world.high))
            rewards.append(step.reward)
        assert np.array_equal(episode.observations, given)
        again = world.env.reset(seed=_seed(data, number))[0]
        assert np.array_equal(again, given[0])
        assert np.array_equal(episode.actions, actions)
        assert np.abs(episode.actions).max() > 1  # in the env's units
        assert np.array_equal(episode.rewards, rewards)
        assert episode.truncations.tolist() == [False] * 29 + [True]
        assert not episode.terminations.any()
    world.close()
    returns = [episode.rewards.sum() for episode in data.iterate_episodes()]
    assert returns == pytest.approx(evaluate(pendulum, episodes=3, seed=4).returns)


@pytest.mark.parametrize("folder", ["", "data"])
def test_a_folder_may_be_relative(
    folder: str, pendulum: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(folder).mkdir(exist_ok=True)
    export(pendulum, "minari", Path(folder) / "near-v0", episodes=1)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / folder))
    assert minari.load_dataset("near-v0").total_steps == 30


def test_a_task_that_is_registered_by_its_class(tmp_path: Path) -> None:
    """Its making cannot be written down, its spaces can."""
    gymnasium.register("ByClass-v0", entry_point=PendulumEnv, max_episode_steps=20)
    try:
        export(untrained("ByClass-v0"), "minari", tmp_path / "class-v0", episodes=1)
    finally:
        del gymnasium.registry["ByClass-v0"]
    data = minari.MinariDataset(tmp_path / "class-v0" / "data")
    assert data.total_steps == 20
    assert (data.observation_space.shape, data.action_space.shape) == ((3,), (1,))


def _seed(data: Any, number: int) -> int:
    return next(iter(data.storage.get_episode_metadata([number])))["seed"]


def test_a_fall_is_a_termination_and_nothing_else_is_left(tmp_path: Path) -> None:
    cart = untrained("InvertedPendulum-v5")
    export(cart, "minari", tmp_path / "cart-v2", episodes=2)
    data = minari.MinariDataset(tmp_path / "cart-v2" / "data")
    for episode in data.iterate_episodes():
        assert episode.terminations[-1]
        assert not episode.truncations.any()
        assert len(episode.observations) == len(episode.actions) + 1
        assert episode.observations.dtype == np.float64  # as the env gives them
    assert [path.name for path in tmp_path.iterdir()] == ["cart-v2"]


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("pendulum", {}, "must end in a name and a version, such as cheetah-v0"),
        ("there-v0", {}, "exists; give another name"),
        ("none/pendulum-v0", {}, "make the folder .*none first"),
        ("pendulum-v0", {"episodes": 0}, "episodes: must be at least 1, got 0"),
    ],
)
def test_bad_input_is_one_line(
    pendulum: Policy, tmp_path: Path, name: str, settings: dict[str, Any], said: str
) -> None:
    (tmp_path / "there-v0").mkdir()
    with pytest.raises(UsageError, match=said):
        export(pendulum, "minari", tmp_path / name, **settings)


def test_missing_extra_is_one_line(
    pendulum: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(UsageError, match=r"pip install 'pacesetter\[minari\]'"):
        export(pendulum, "minari", tmp_path / "pendulum-v0", episodes=1)

"""What would be sent to the hub, seen by a double of its client that keeps it in a folder."""

import inspect
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from policies import untrained

from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.evaluation import evaluate
from pacesetter.media.hub import load_from_hub, push
from pacesetter.policy import load

hub = pytest.importorskip("huggingface_hub", reason="needs the extra hub")
yaml = pytest.importorskip("yaml")
REAL = hub.HfApi, hub.hf_hub_download


class Double:
    """Takes only what the real client takes, and keeps repositories below a folder."""

    folder: Path
    calls: list[str]

    def __init__(self, **settings: Any) -> None:
        inspect.signature(REAL[0]).bind(**settings)

    def create_repo(self, *given: Any, **named: Any) -> None:
        bound = inspect.signature(REAL[0].create_repo).bind(self, *given, **named).arguments
        self.calls.append(f"create private={bound['private']}")
        (self.folder / bound["repo_id"]).mkdir(parents=True, exist_ok=bound["exist_ok"])

    def create_commit(self, *given: Any, **named: Any) -> Any:
        bound = inspect.signature(REAL[0].create_commit).bind(self, *given, **named).arguments
        self.calls.append(f"commit {bound['commit_message']}")
        for operation in bound["operations"]:
            with operation.as_file() as file:
                (self.folder / bound["repo_id"] / operation.path_in_repo).write_bytes(file.read())
        return SimpleNamespace(repo_url=f"https://huggingface.co/{bound['repo_id']}")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the double keeps repositories."""
    folder = tmp_path / "hub"

    def download(*given: Any, **named: Any) -> str:
        bound = inspect.signature(REAL[1]).bind(*given, **named).arguments
        path = folder / bound["repo_id"] / bound["filename"]
        if not path.exists():
            raise hub.errors.LocalEntryNotFoundError("not found\nand more")
        return str(path)

    monkeypatch.setattr(Double, "folder", folder, raising=False)
    monkeypatch.setattr(Double, "calls", [], raising=False)
    monkeypatch.setattr(hub, "HfApi", Double)
    monkeypatch.setattr(hub, "hf_hub_download", download)
    return folder


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A policy as a run writes it."""
    about = {"algorithm": "td3", "step": 20_000, "seed": 3, "score": -900.5, "score_episodes": 4}
    kwargs = {"max_episode_steps": 20}
    policy = untrained("Pendulum-v1", env_kwargs=kwargs, versions={"jax": "0.10.2"}, **about)
    policy.save(tmp_path / "policy.safetensors")
    return tmp_path / "policy.safetensors"


def test_what_is_sent_comes_back(folder: Path, file: Path) -> None:
    address = push(file, "someone/pendulum", episodes=2, seed=5)
    assert address == "https://huggingface.co/someone/pendulum"
    assert Double.calls == ["create private=False", "commit td3 on Pendulum-v1, by pacesetter"]
    sent = folder / "someone" / "pendulum"
    assert {path.name for path in sent.iterdir()} == {"policy.safetensors", "README.md"}
    assert (sent / "policy.safetensors").read_bytes() == file.read_bytes()
    fetched, observation = load_from_hub("someone/pendulum"), np.ones(3, np.float32)
    assert np.array_equal(fetched(observation), load(file)(observation))


def test_card_says_what_it_is(folder: Path, file: Path) -> None:
    push(file, "someone/pendulum", episodes=2, seed=5, command="pacesetter train td3 Pendulum-v1")
    text = (folder / "someone" / "pendulum" / "README.md").read_text()
    scored = evaluate(load(file), episodes=2, seed=5)
    for said in (
        "| task | Pendulum-v1 |",
        "| algorithm | td3 |",
        "| training | 20,000 env steps, seed 3 |",
        f"| return | {scored.mean:,.1f} +- {scored.std:,.1f} over 2 fresh episodes, seed 5 |",
        "| return in training | -900.5 over 4 episodes |",
        "| versions | jax 0.10.2 |",
        "pacesetter train td3 Pendulum-v1\n",
        'load_from_hub("someone/pendulum")',
    ):
        assert said in text
    data = yaml.safe_load(text.split("---\n")[1])
    assert "reinforcement-learning" in data["tags"]
    result = data["model-index"][0]["results"][0]
    assert result["dataset"]["type"] == "Pendulum-v1"
    assert result["metrics"][0]["value"] == f"{scored.mean:.2f} +/- {scored.std:.2f}"


def test_words_of_a_policy_are_words_of_the_card(folder: Path, file: Path) -> None:
    """A policy of somebody else's may say anything of itself."""
    policy = load(file)
    policy.about.update(seed="[x](y)", versions={"jax": "<b>\n| 1"})
    policy.save(file)
    push(file, "someone/pendulum", episodes=1, command="train\n```\n# A title")
    text = (folder / "someone" / "pendulum" / "README.md").read_text()
    assert ", seed [x]\\(y) |\n" in text
    assert "| versions | jax \\<b\\>\\\\n\\| 1 |\n" in text
    assert "```\ntrain\\n```\\n# A title\n```\n" in text


def test_command_is_that_of_the_run_folder_and_a_film_is_played(folder: Path, file: Path) -> None:
    settings = {"algorithm": "td3", "env": "Pendulum-v1", "name": "td3", "seed": 0}
    settings |= {"steps": 1000, "eval_every": 100}
    record = {"schema": 1, "threads": 2, "settings": settings, "command": "pacesetter train it"}
    (file.parent / "config.json").write_text(json.dumps(record))
    film = file.with_name("film.mp4")
    film.write_bytes(b"moving pictures")
    push(file, "someone/pendulum", episodes=1, private=True, video=film)
    sent = folder / "someone" / "pendulum"
    assert "```\npacesetter train it\n```" in (sent / "README.md").read_text()
    assert (sent / "replay.mp4").read_bytes() == b"moving pictures"
    assert Double.calls[0] == "create private=True"


def test_bad_input_sends_nothing_and_is_one_line(folder: Path, file: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        push(tmp_path / "none.safetensors", "someone/pendulum")
    with pytest.raises(UsageError, match="episodes: must be at least 1"):
        push(file, "someone/pendulum", episodes=0)
    with pytest.raises(UsageError, match=r"must end in \.mp4"):
        push(file, "someone/pendulum", video="film.gif")
    with pytest.raises(UsageError, match=r"film\.mp4"):
        push(file, "someone/pendulum", video=tmp_path / "film.mp4", episodes=1)
    assert Double.calls == []
    with pytest.raises(UsageError, match=r"hub: someone/none: not found and more$"):
        load_from_hub("someone/none")


def test_refusal_of_the_hub_is_one_line(
    folder: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*given: Any, **named: Any) -> None:
        raise hub.errors.LocalTokenNotFoundError("Token is required\n(no token)")

    monkeypatch.setattr(Double, "create_repo", refuse)
    with pytest.raises(
        UsageError, match=r"Token is required \(no token\); check the name, and log in"
    ):
        push(file, "someone/pendulum", episodes=1)
    assert not folder.exists()


def test_missing_extra_is_one_line(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for call in (lambda: push(file, "a/b"), lambda: load_from_hub("a/b")):
        with pytest.raises(UsageError, match=r"pip install 'pacesetter\[hub\]'"):
            call()


def test_card_of_a_file_with_odd_words(folder: Path, tmp_path: Path) -> None:
    odd = untrained("Pendulum-v1", algorithm="td3", score=None, versions=["jax"], step=5)
    odd.save(tmp_path / "odd.safetensors")
    push(tmp_path / "odd.safetensors", "someone/odd", episodes=1)
    text = (folder / "someone" / "odd" / "README.md").read_text()
    assert "return in training" not in text


def test_verb_plays_the_wrapped_task_and_no_other(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "odd_envs:Doubled"
    untrained("Pendulum-v1", algorithm="td3", step=5, wrap=[name]).save(
        tmp_path / "half.safetensors"
    )
    words = ["push", str(tmp_path / "half.safetensors"), "someone/half", "--episodes", "1"]
    assert main([*words, "--allow", name]) == 0
    assert (folder / "someone" / "half" / "README.md").exists()
    assert main([*words, "--wrap", "odd_envs:Raised", "--allow", name]) == 2
    assert "wrap: the card tells of the task" in capsys.readouterr().err
    untrained("HalfCheetah-v4", algorithm="td3", step=5).save(tmp_path / "v4.safetensors")
    words = ["push", str(tmp_path / "v4.safetensors"), "someone/v4", "--episodes", "1"]
    for other in (["--env", "HalfCheetah-v5"], ["--env.max_episode_steps", "9"]):
        assert main([*words, *other]) == 2
        assert "env: the card tells of the task" in capsys.readouterr().err
    assert not (folder / "someone" / "v4").exists()
    short = {"max_episode_steps": 9}
    untrained("HalfCheetah-v4", algorithm="td3", step=5, env_kwargs=short).save(
        tmp_path / "v4.safetensors"
    )
    assert main([*words, "--env", "HalfCheetah-v4"]) == 0

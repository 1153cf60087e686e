"""The ONNX model is the policy: for every kind of network, and never written where it is not."""

import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pacesetter import load
from pacesetter.errors import UsageError
from pacesetter.media.export import export
from pacesetter.networks.forward import ACTIVATIONS, ENCODER, OUTPUTS
from pacesetter.policy import Policy

onnx = pytest.importorskip("onnx", reason="needs the extra onnx")
onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra onnx")

ROOT = Path(__file__).parents[2]
CHAMPION = ROOT / "champions" / "HalfCheetah-v4-sac.safetensors"


def handmade(
    rng: np.random.Generator, activation: str, output: str, actors: int, norm: bool, scaled: bool
) -> Policy:
    """Eleven inputs, two hidden layers, three actions of unlike bounds."""

    def draw(*shape: int) -> Any:
        return rng.normal(0, 0.4, shape).astype(np.float32)

    def hidden(inputs: int) -> Any:
        layer = {"kernel": draw(inputs, 32), "bias": draw(32)}
        return layer | {"scale": 1 + draw(32), "offset": draw(32)} if norm else layer

    low, high = np.float32([-1, -0.4, -3]), np.float32([1, 0.4, 7])
    about = {"env": "Some-v0", "algorithm": "td3", "step": 9, "score": 1.5, "env_kwargs": {"a": 1}}
    return Policy(
        [[hidden(11), hidden(32), {"kernel": draw(32, 3), "bias": draw(3)}] for _ in range(actors)],
        activation,
        output,
        low,
        high,
        normalizer=(3 * draw(11), np.exp(draw(11))) if scaled else None,
        about=about,
    )


def run(path: Path, observation: Any) -> Any:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return session.run(None, {"observation": observation})[0]


def test_encoder_of_td7_is_part_of_the_model(tmp_path: Path, rng: np.random.Generator) -> None:
    """Its first stage: the linear embedding beside the state encoder's, each of mean length 1."""
    plain = handmade(rng, "relu", "tanh", 1, norm=False, scaled=True)
    sizes = [(11, 16), (16, 16), (16, 8)]
    encoder: dict[str, Any] = {}
    for (kernel, bias), shape in zip(ENCODER, sizes, strict=True):
        encoder |= {kernel: rng.normal(0, 0.4, shape).astype(np.float32)}
        encoder |= {bias: rng.normal(0, 0.4, shape[1:]).astype(np.float32)}
    first, second, last = plain.actors[0]
    wider = second | {"kernel": rng.normal(0, 0.2, (40, 32)).astype(np.float32)}
    policy = replace(plain, actors=[[first | encoder, wider, last]])
    export(policy, "onnx", tmp_path / "walker.onnx")
    observation = rng.normal(size=(7, 11)).astype(np.float32)
    found = run(tmp_path / "walker.onnx", observation)
    np.testing.assert_allclose(found, policy(observation), atol=2e-5)
    assert not np.allclose(found[0], found[1])


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize(("actors", "norm", "scaled"), [(1, False, False), (3, True, True)])
def test_model_gives_the_policys_actions(
    tmp_path: Path,
    rng: np.random.Generator,
    activation: str,
    output: str,
    actors: int,
    norm: bool,
    scaled: bool,
) -> None:
    policy = handmade(rng, activation, output, actors, norm, scaled)
    path = tmp_path / "policy.onnx"
    assert str(path) in export(policy, "onnx", path)
    for batch in (1, 7):
        observation = rng.normal(size=(batch, 11)).astype(np.float32)
        given = run(path, observation)
        assert given.dtype == np.float32
        apart = np.abs(given - policy(observation)) / (policy.high - policy.low)
        assert apart.max() < 2e-6
    far = np.float32(1e6) * rng.choice([-1, 0, 1], (7, 11)).astype(np.float32)
    given = run(path, far)
    assert ((given >= policy.low) & (given <= policy.high)).all()


def test_champion_on_its_own_task(tmp_path: Path) -> None:
    from pacesetter.evaluation import enter

    policy, path = load(CHAMPION), tmp_path / "champion.onnx"
    export(policy, "onnx", path)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    world = enter(policy, None, 3)
    observation, apart = world.reset(0), []
    for _ in range(200):
        action = session.run(None, {"observation": observation[None]})[0][0]
        apart.append(np.abs(action - policy(observation)).max() / 2)
        observation = world.step(action).observation
    world.close()
    assert np.mean(apart) < 1e-6
    assert world.earned > 800  # of some 6 a step


def test_metadata_says_where_it_comes_from(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "policy.onnx"
    export(handmade(rng, "relu", "tanh", 1, False, False), "onnx", path)
    model = onnx.load(path)
    found = {entry.key: entry.value for entry in model.metadata_props}
    assert found["env"] == "Some-v0"
    assert found["algorithm"] == "td3"
    assert [json.loads(found[key]) for key in ("step", "score", "env_kwargs")] == [9, 1.5, {"a": 1}]
    assert np.allclose(json.loads(found["high"]), [1, 0.4, 7])
    assert model.opset_import[0].version == 17
    assert model.graph.input[0].type.tensor_type.shape.dim[0].dim_param == "batch"


@pytest.mark.parametrize("fault", ["_input", "_mean", "_layer_norm", "_bounds"])
def test_a_model_that_differs_is_refused(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    """Each part of the graph left out by itself."""
    parts: dict[str, Any] = {
        "_input": lambda graph, policy: "observation",
        "_mean": lambda graph, actions: actions[0],
        "_layer_norm": lambda graph, x, scale, offset: x,
        "_bounds": lambda graph, policy, action: action,
    }
    policy, path = handmade(rng, "relu", "tanh", 2, True, True), tmp_path / "policy.onnx"
    monkeypatch.setattr(f"pacesetter.media.onnx.{fault}", parts[fault])
    with pytest.raises(UsageError, match="nothing is written"):
        export(policy, "onnx", path)
    assert list(tmp_path.iterdir()) == []


def test_a_model_of_rounded_weights_is_refused(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The written float32 file is checked too, not only its twin in float64."""
    from pacesetter.media import onnx as module

    build = module.build

    def rounded(policy: Policy, dtype: Any = np.float32) -> bytes:
        if dtype is np.float32:
            layers = [
                {name: array.astype(np.float16).astype(np.float32) for name, array in layer.items()}
                for layer in policy.actors[0]
            ]
            return build(Policy([layers], "relu", "tanh", policy.low, policy.high))
        return build(policy, dtype)

    monkeypatch.setattr(module, "build", rounded)
    with pytest.raises(UsageError, match="on average in float32; nothing is written"):
        export(handmade(rng, "relu", "tanh", 1, False, False), "onnx", tmp_path / "policy.onnx")


def test_bad_input_and_missing_extra_are_one_line(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = handmade(rng, "relu", "tanh", 1, False, False)
    with pytest.raises(UsageError, match=r"must end in \.onnx"):
        export(policy, "onnx", tmp_path / "policy.pb")
    with pytest.raises(UsageError, match="cannot write"):
        export(policy, "onnx", tmp_path / "none" / "policy.onnx")
    with pytest.raises(UsageError, match="export: unknown 'onx'; did you mean onnx"):
        export(policy, "onx", tmp_path / "policy.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UsageError, match=r"pip install 'pacesetter\[onnx\]'"):
        export(policy, "onnx", tmp_path / "policy.onnx")
    assert list(tmp_path.iterdir()) == []


def test_robot_runs_it_without_this_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, path = load(CHAMPION), tmp_path / "champion.onnx"
    export(policy, "onnx", path)
    for name in [name for name in sys.modules if name.split(".")[0] in ("pacesetter", "jax")]:
        monkeypatch.setitem(sys.modules, name, None)  # importing it now fails
    monkeypatch.setattr(sys, "argv", ["robot.py", str(path)])
    runpy.run_path(str(ROOT / "examples" / "robot.py"), run_name="__main__")
    said = capsys.readouterr()
    assert "sac on HalfCheetah-v4: 17 sensors" in said.err
    lines = [[float(word) for word in line.split()] for line in said.out.splitlines()]
    assert len(lines) == 3
    assert lines[0] == pytest.approx(policy(np.zeros(17)), abs=5e-4 + 1e-6)


def test_robot_is_short() -> None:
    import ast

    text = (ROOT / "examples" / "robot.py").read_text()
    documented = (ast.Module, ast.FunctionDef)
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, documented)]
    docs = sum(
        node.body[0].end_lineno - node.body[0].lineno + 1  # type: ignore[operator]
        for node in found
        if ast.get_docstring(node)
    )
    assert sum(bool(line.strip()) for line in text.splitlines()) - docs <= 20

"""examples/act.py acts as the package does, without the package."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import act
import numpy as np
import pytest

from pacesetter import load
from pacesetter.policy import Policy

EXAMPLE = Path(act.__file__)
LOW, HIGH = np.array([-0.4, 0.0], np.float32), np.array([0.4, 3.0], np.float32)


def network(rng: np.random.Generator, norm: bool) -> list[dict[str, Any]]:
    """A 3-5-4-2 network, with layer norm or without."""
    layers: list[dict[str, Any]] = []
    for inputs, outputs in ((3, 5), (5, 4), (4, 2)):
        kernel = rng.normal(scale=0.5, size=(inputs, outputs))
        layer = {"kernel": kernel, "bias": rng.normal(scale=0.2, size=outputs)}
        if norm and outputs != 2:
            layer |= {"scale": rng.normal(size=outputs), "offset": rng.normal(size=outputs)}
        layers.append({name: x.astype(np.float32) for name, x in layer.items()})
    return layers


def written(path: Path, rng: np.random.Generator, kind: dict[str, Any]) -> Path:
    """A policy file of one kind."""
    normalizer = None
    if kind["normalize"]:
        normalizer = (rng.normal(size=3).astype(np.float32), np.array([0.5, 2, 0.01], np.float32))
    actors: list[Any] = [network(rng, kind["norm"]) for _ in range(kind["actors"])]
    Policy(actors, kind["activation"], kind["output"], LOW, HIGH, normalizer).save(path)
    return path


KINDS: dict[str, dict[str, Any]] = {
    "td3": {"actors": 1, "norm": False, "activation": "relu", "output": "tanh", "normalize": False},
    "norm": {"actors": 1, "norm": True, "activation": "relu", "output": "tanh", "normalize": True},
    "sunrise": {"actors": 3, "norm": False, "activation": "relu", "output": "tanh"}
    | {"normalize": False},
    "trpo": {"actors": 1, "norm": False, "activation": "tanh", "output": "clip", "normalize": True},
}


@pytest.mark.parametrize("kind", KINDS)
def test_same_actions(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    path = written(tmp_path / "policy.safetensors", rng, KINDS[kind])
    policy, copied = load(path), act.read(path)
    observations = rng.normal(scale=2, size=(50, 3))
    ours = np.stack([policy(x) for x in observations])
    theirs = np.stack([act.act(copied, x) for x in observations])
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=3e-6)
    assert np.ptp(ours, axis=0).min() > 0.1


def test_command_without_the_package(tmp_path: Path, rng: np.random.Generator) -> None:
    """It prints the action, and neither it nor what it imports imports pacesetter or JAX."""
    path = written(tmp_path / "policy.safetensors", rng, KINDS["td3"])
    code = f"""
import runpy, sys
sys.argv = ["act.py", {str(path)!r}, "0.1", "-0.3", "0.8"]
runpy.run_path({str(EXAMPLE)!r}, run_name="__main__")
assert not {{"jax", "pacesetter"}} & {{*sys.modules}}
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    shown = [float(word) for word in result.stdout.split()]
    np.testing.assert_allclose(shown, load(path)([0.1, -0.3, 0.8]), rtol=0, atol=3e-6)

"""A policy in the form of another program: one verb, one line that says what was written."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np

from pacesetter.envs import Recipe
from pacesetter.errors import unknown
from pacesetter.media.minari import to_minari
from pacesetter.media.onnx import to_onnx
from pacesetter.media.sb3 import to_sb3
from pacesetter.policy import Policy

TARGETS = ("onnx", "minari", "sb3")


def export(
    policy: Policy,
    to: str,
    path: str | Path,
    *,
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
) -> str:
    """Write a policy as an ONNX model, a Minari data set of its episodes, or a script for SB3.

    Returns one line for people. `env`, `episodes` and `seed` are of the episodes; ONNX has none.
    Raises a UsageError for bad input, a missing extra, or a model that differs from the policy.
    """
    path = Path(path)
    match to:
        case "onnx":
            found = to_onnx(policy, path)
            inputs, outputs = policy.observation_size, len(policy.low)
            return (
                f"{path}: observations (batch, {inputs}) to actions (batch, {outputs}) in the "
                f"env's units; onnxruntime gives the policy's actions to {found.exact:.1e} of "
                f"their range in float64, {found.rounded:.1e} on average in float32"
            )
        case "minari":
            made = to_minari(
                policy, path, episodes=episodes, env=env, env_kwargs=env_kwargs, seed=seed
            )
            return (
                f"{path}: {episodes} episodes, return {np.mean(made):,.1f} +- {np.std(made):,.1f}; "
                f"load it by MINARI_DATASETS_PATH={shlex.quote(str(path.parent))} and "
                f"minari.load_dataset({path.name!r})"
            )
        case "sb3":
            file = to_sb3(policy, path, env=env, env_kwargs=env_kwargs)
            return f"{path}: its `model` has SB3's predict(); it reads {file.name} beside it"
        case _:
            raise unknown("export", to, TARGETS)

"""Act with a policy file on a machine that has NumPy and safetensors, and no pacesetter.

    python act.py policy.safetensors 0.1 -0.3 0.8     # an observation in, an action out

Copy this file to the robot: `read` once, `act` at each step.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

NORM_EPSILON = 1e-5


def read(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """All arrays of a policy file by name, and its table of words."""
    with safe_open(str(path), "numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return arrays, json.loads(file.metadata()["table"])


def act(policy: tuple[dict[str, Any], dict[str, Any]], observation: Any) -> Any:
    """The action (A,) in the task's own units for a flat observation (O,)."""
    arrays, table = policy
    x = np.asarray(observation, np.float32)
    if "mean" in arrays:
        x = np.clip((x - arrays["mean"]) / arrays["deviation"], -10, 10)
    actors = 1 + max(int(name.split(".")[1]) for name in arrays if name.startswith("actors."))
    action = np.mean([_actor(arrays, table, n, x) for n in range(actors)], axis=0)
    share = (np.clip(action, -1, 1) + 1) / 2
    return arrays["low"] * (1 - share) + arrays["high"] * share


def _actor(arrays: dict[str, Any], table: dict[str, Any], n: int, x: Any) -> Any:
    """The action in [-1, 1] of one network."""
    if f"actors.{n}.0.encoder_kernel_1" in arrays:
        raise SystemExit("a policy of td7 reads an encoder; export it to ONNX instead")
    i = 0
    while f"actors.{n}.{i + 1}.kernel" in arrays:
        x = x @ arrays[f"actors.{n}.{i}.kernel"] + arrays[f"actors.{n}.{i}.bias"]
        if f"actors.{n}.{i}.scale" in arrays:
            x = (x - x.mean()) / np.sqrt(x.var() + NORM_EPSILON)
            x = x * arrays[f"actors.{n}.{i}.scale"] + arrays[f"actors.{n}.{i}.offset"]
        x = np.tanh(x) if table["activation"] == "tanh" else np.maximum(x, 0)
        i += 1
    x = x @ arrays[f"actors.{n}.{i}.kernel"] + arrays[f"actors.{n}.{i}.bias"]
    return np.tanh(x) if table["output"] == "tanh" else np.clip(x, -1, 1)


if __name__ == "__main__":
    print(*act(read(sys.argv[1]), [float(word) for word in sys.argv[2:]]))

"""Wrappers around a task: those that are named, in order, and Gymnasium's own that flattens."""

from importlib import import_module
from typing import Any

import gymnasium
from gymnasium.spaces import Dict, Tuple
from gymnasium.wrappers import FlattenObservation

from pacesetter.envs.calls import call
from pacesetter.envs.spaces import refuse_images, space_of
from pacesetter.errors import TaskError, UsageError

Env = gymnasium.Env[Any, Any]


def wrapped(env: Env, name: str) -> Env:
    """The env inside a wrapper `module:Class`, which takes the env and nothing else."""
    module, colon, attribute = name.partition(":")
    if not colon:
        raise UsageError(f"wrap: '{name}' must be module:Class, such as my_package:MyWrapper")
    try:
        outer = call(f"wrap: cannot use '{name}'", None, _put, module, attribute, env)
    except TaskError as error:
        raise UsageError(str(error)) from None
    if not isinstance(outer, gymnasium.Env):
        raise UsageError(f"wrap: '{name}' must give an env, got a {type(outer).__name__}")
    return outer


def _put(module: str, attribute: str, env: Env) -> Any:
    return getattr(import_module(module), attribute)(env)


def flattened(name: str, env: Env) -> Env:
    """The env with Dict and Tuple observations as one row of numbers; others stay as they are."""
    space = space_of(name, env, "observation")
    if not isinstance(space, (Dict, Tuple)):
        return env
    refuse_images(name, space)
    try:
        return call(f"env: {name}: cannot flatten observations", None, FlattenObservation, env)
    except TaskError as error:
        raise UsageError(str(error)) from None


def notes_on_wrappers(env: Env) -> list[str]:
    """That an observation is flattened, and from what."""
    if not isinstance(env, FlattenObservation):
        return []
    inner: Any = env.env.observation_space
    parts = ", ".join(map(str, inner.spaces)) if isinstance(inner, Dict) else f"{len(inner)} parts"
    size = env.observation_space.shape
    kind = type(inner).__name__
    return [f"observation is a {kind} ({parts}), flattened to {size} numbers"]

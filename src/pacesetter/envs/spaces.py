"""The spaces of a task: which ones can be learned on, and the bounds of its actions."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from pacesetter.errors import UsageError
from pacesetter.types import Floats


def check_spaces(name: str, env: gymnasium.Env[Any, Any]) -> None:
    """Refuse spaces that are no boxes of numbers, or actions without finite bounds."""
    for what in ("observation", "action"):
        _check_space(f"env: {name}: {what} space", getattr(env, f"{what}_space", None))
    if not np.issubdtype(env.action_space.dtype, np.floating):
        raise UsageError(
            f"env: {name}: action space: must be of float32 or float64, got {env.action_space}"
        )
    if not np.isfinite(np.concatenate(action_bounds(env))).all():
        raise UsageError(
            f"env: {name}: action space: its bounds must be finite, got {env.action_space}"
        )


def _check_space(what: str, space: Any) -> None:
    if not isinstance(space, Box):
        hint = " (wrap it in FlattenObservation)" if "observation" in what else ""
        raise UsageError(f"{what}: must be a Box, got {type(space).__name__}{hint}")
    if 0 in space.shape:
        raise UsageError(f"{what}: must hold at least one number, its shape is {space.shape}")


def action_bounds(env: gymnasium.Env[Any, Any]) -> tuple[Floats, Floats]:
    """The action bounds in float32, rounded inwards so that no action leaves a float64 box."""
    space: Any = env.action_space
    with np.errstate(over="ignore"):  # bounds beyond float32 become infinite and are refused
        low, high = (bound.astype(np.float32).ravel() for bound in (space.low, space.high))
    low = np.where(low < space.low.ravel(), np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high > space.high.ravel(), np.nextafter(high, np.float32(-np.inf)), high)
    return low, high

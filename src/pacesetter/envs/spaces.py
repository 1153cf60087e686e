"""The spaces of a task: which ones can be learned on, and the bounds of its actions."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Tuple

from pacesetter.envs.calls import call
from pacesetter.errors import TaskError, UsageError, show
from pacesetter.types import Floats

IMAGE_SIDE = 16  # pixels of height and width from which numbers are taken for an image
WRAP = "--wrap module:Class"
WAYS_OUT = {
    "observation": f"give a wrapper that makes a Box of it, such as {WRAP}",
    "action": f"train on continuous actions, or give a wrapper that takes them, such as {WRAP}",
}


def space_of(name: str, env: gymnasium.Env[Any, Any], what: str) -> Any:
    """The observation or the action space of an env; None if it has none."""
    try:
        return call(f"env: {name}: {what} space: failed", None, getattr, env, f"{what}_space", None)
    except TaskError as error:
        raise UsageError(str(error)) from None


def refuse_images(name: str, space: Any) -> None:
    """Refuse pictures, also inside a Dict or a Tuple: layers of plain units do not see."""
    inside: Any = space.spaces if isinstance(space, (Dict, Tuple)) else ()
    for part in inside.values() if isinstance(inside, dict) else inside:
        refuse_images(name, part)
    if isinstance(space, Box) and _is_image(space):
        size = "x".join(map(str, space.shape))
        raise UsageError(
            f"env: {name}: observation space: is an image of {size} {space.dtype}, and no "
            f"algorithm here has layers that see; train on numbers, or {WAYS_OUT['observation']}"
        )


def _is_image(space: Box) -> bool:
    """Bytes in colour, or anything with height and width, grey ones as bytes."""
    sides = sum(side >= IMAGE_SIDE for side in space.shape)
    if space.dtype == np.uint8:
        return len(space.shape) >= 3 or sides >= 2
    return len(space.shape) >= 3 and sides >= 2


def check_spaces(name: str, env: gymnasium.Env[Any, Any]) -> None:
    """Refuse spaces that are no boxes of numbers, or actions without finite bounds."""
    for what in ("observation", "action"):
        _check_space(name, what, space_of(name, env, what))
    refuse_images(name, env.observation_space)
    where, space = f"env: {name}: action space", show(env.action_space)
    if not np.issubdtype(env.action_space.dtype, np.floating):
        raise UsageError(
            f"{where}: must be of float32 or float64, got {space}; {WAYS_OUT['action']}"
        )
    low, high = action_bounds(env)
    if not np.isfinite(np.concatenate([low, high])).all():
        raise UsageError(
            f"{where}: its bounds must be finite, got {space}; give some with a wrapper ({WRAP})"
        )
    if not (low <= high).all():
        n = int(np.flatnonzero(low > high)[0])
        raise UsageError(f"{where}: number {n} has no float32 number between its bounds")


def _check_space(name: str, what: str, space: Any) -> None:
    where = f"env: {name}: {what} space"
    if not isinstance(space, Box):
        raise UsageError(f"{where}: must be a Box, got {type(space).__name__}; {WAYS_OUT[what]}")
    if 0 in space.shape:
        raise UsageError(f"{where}: must hold at least one number, its shape is {space.shape}")
    shapes = [np.shape(bound) for bound in (space.low, space.high)]
    kinds = [getattr(bound, "dtype", np.dtype("O")).kind for bound in (space.low, space.high)]
    if shapes != [space.shape] * 2 or not {*kinds} <= {*"biuf"}:
        raise UsageError(f"{where}: its bounds must be numbers of its shape {space.shape}")


def action_bounds(env: gymnasium.Env[Any, Any]) -> tuple[Floats, Floats]:
    """The action bounds in float32, rounded inwards so that no action leaves a float64 box."""
    space: Any = env.action_space
    with np.errstate(over="ignore"):  # bounds beyond float32 become infinite and are refused
        low, high = (bound.astype(np.float32).ravel() for bound in (space.low, space.high))
    low = np.where(low < space.low.ravel(), np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high > space.high.ravel(), np.nextafter(high, np.float32(-np.inf)), high)
    return low, high

"""What a task gives, cast where it can be cast: observations, rewards and flags.

A ValueError says what is wrong and how to mend the task. Notes say what was cast.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from pacesetter.errors import show
from pacesetter.types import ALLOWED, LARGEST, Floats, Shape

FINITE = np.float64(LARGEST)  # as a Python number it would be infinity beside a float16
ROUNDING = 1e-6  # of a bound; float32 has seven digits


class Step(NamedTuple):
    """What one env step gave; `terminated` ends the task, `truncated` only the episode."""

    observation: Floats
    reward: float
    terminated: bool
    truncated: bool
    info: Mapping[Any, Any]

    @property
    def ended(self) -> bool:
        return self.terminated or self.truncated


def step(given: Any, shape: Shape) -> Step:
    """What `step` of a task returned, whose observations have a shape."""
    if not (isinstance(given, tuple) and len(given) == 5):
        raise ValueError("step: must return (observation, reward, terminated, truncated, info)")
    seen, paid, terminated, truncated, info = given
    if not isinstance(info, (dict, Mapping)):
        raise ValueError(f"info: must be a dict, got {show(info)}; {{}} will do")
    if type(terminated) is not bool:
        terminated = flag("terminated", terminated)
    if type(truncated) is not bool:
        truncated = flag("truncated", truncated)
    return Step(observation(seen, shape), reward(paid), terminated, truncated, info)


def observation(given: Any, shape: Shape) -> Floats:
    """Flat float32 numbers of an observation of a shape, none too large to learn from."""
    try:
        raw = np.asarray(given)
        if raw.dtype.kind not in "bfiuO":
            raise TypeError
        inside = np.abs(raw) <= FINITE
        fine = np.logical_and.reduce(inside, axis=None)  # `all` without a call of Python
        flat = np.array(raw if fine else 0, np.float32).ravel()
    except Exception:
        raise ValueError(f"observation: must be numbers, got {show(given)}") from None
    if raw.shape != shape and not raw.size == np.prod(shape) == 1:
        raise ValueError(f"observation: must have shape {shape} as its space, has {raw.shape}")
    if not fine:
        n = int(np.flatnonzero(~inside)[0])
        raise ValueError(f"observation: must be {ALLOWED}, number {n} is {raw.ravel()[n]}")
    return flat


def reward(given: Any) -> float:
    """One number that is not too large to learn from, which may come as an array of one."""
    number = given if isinstance(given, (int, float, np.floating)) else _single("reward", given)
    if isinstance(number, np.floating):
        number = float(number)
    if not abs(number) <= LARGEST:
        raise ValueError(f"reward: must be {ALLOWED}, got {show(given)}")
    return float(number)


def flag(what: str, given: Any) -> bool:
    """True or False, which may come as 0 or 1 or as an array of one."""
    if not isinstance(given, (bool, np.bool_)) and _single(what, given) not in (0, 1):
        raise ValueError(f"{what}: must be True or False, got {show(given)}")
    return bool(given)


def _single(what: str, given: Any) -> Any:
    try:
        array = np.asarray(given)
        if array.size == 1 and array.dtype.kind in "bfiu":
            return array.item()
    except Exception:  # of a ragged list, or of an object that only looks like an array
        pass
    raise ValueError(f"{what}: must be one number, got {show(given)}")


def reward_terms(given: Mapping[Any, Any]) -> Iterator[tuple[str, float]]:
    """The entries of an info dict whose names begin with `reward_` and that are numbers."""
    for name, value in given.items():
        named = isinstance(name, str) and name.startswith("reward_")
        if named and isinstance(value, (int, float, np.floating, np.integer)):
            yield name, float(value)


# What a person should know of what was cast; seen once, in the first step of a run.


def notes_on_observation(given: Any, space: Any) -> Iterator[str]:
    """How an observation differs from its space in type, or lies outside by more than rounding."""
    array = np.asarray(given)
    if not isinstance(given, (np.ndarray, np.generic)):
        yield f"observation is a {type(given).__name__}, taken as an array"
    elif not np.can_cast(array.dtype, space.dtype):
        yield f"observation is {array.dtype} in a space of {space.dtype}, cast to float32"
    if array.shape != space.shape:
        yield f"observation has shape {array.shape} in a space of {space.shape}"
    values = array.astype(np.float64).ravel()
    low, high = (np.asarray(bound, np.float64).ravel() for bound in (space.low, space.high))
    slack = [ROUNDING * np.maximum(1.0, np.abs(bound)) for bound in (low, high)]
    outside = np.flatnonzero((values < low - slack[0]) | (values > high + slack[1]))
    if outside.size:
        n = int(outside[0])
        yield f"observation number {n} is {values[n]}, outside its space [{low[n]}, {high[n]}]"


def notes_on_step(given: tuple[Any, ...]) -> Iterator[str]:
    """What was cast of a reward and two flags."""
    paid, *flags = given
    if isinstance(paid, bool) or not isinstance(paid, (int, float, np.floating, np.integer)):
        yield f"reward is {_kind(paid)}, taken as one number"
    for name, value in zip(("terminated", "truncated"), flags, strict=True):
        if not isinstance(value, (bool, np.bool_)):
            yield f"{name} is {_kind(value)}, taken as a flag"


def _kind(value: Any) -> str:
    shape = getattr(value, "shape", ())
    return f"of shape {shape}" if shape else f"of type {type(value).__name__}"

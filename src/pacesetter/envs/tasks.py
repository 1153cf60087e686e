"""Gymnasium tasks by their id: found, made, and refused where no learner could use them."""

import logging
import re
import warnings
from typing import Any

import gymnasium

from pacesetter.envs.spaces import check_spaces
from pacesetter.errors import UsageError, reason, unknown


def known() -> list[str]:
    """Ids that `make` accepts without a module, without those whose entry point only raises."""

    def works(entry_point: object) -> bool:
        return not getattr(entry_point, "__name__", "").startswith("_raise_")

    return [name for name, spec in gymnasium.registry.items() if works(spec.entry_point)]


def _log_warning(message: str) -> None:
    if "settotalmass" not in message:  # Gymnasium's own models; nothing a user can do
        logging.getLogger(__name__).warning("MuJoCo: %s", message)


def make_quietly(name: str, kwargs: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """gymnasium.make without the warnings that v4 is old and its models use an old keyword."""
    import mujoco

    # Without a handler MuJoCo writes MUJOCO_LOG.TXT into the working directory.
    mujoco.set_mju_user_warning(_log_warning)  # pyright: ignore[reportAttributeAccessIssue]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*The environment .* is out of date.*")
        return gymnasium.make(name, disable_env_checker=True, **kwargs)


def make(name: str, kwargs: dict[str, Any] | None = None) -> gymnasium.Env[Any, Any]:
    """Make a task by its Gymnasium id. Raises UsageError if the id or the task is wrong."""
    plain = name.split(":")[-1]
    if not re.search(r"-v\d+$", plain, re.IGNORECASE) and name not in known():
        versions = [known_name for known_name in known() if known_name.startswith(f"{plain}-v")]
        hint = f"; write {' or '.join(versions)}" if versions else "; such as HalfCheetah-v5"
        raise UsageError(f"env: '{name}' has no version{hint}")
    if ":" not in name and name not in known():
        raise unknown("env", name, known(), see="pacesetter list envs")
    try:
        env = make_quietly(name, kwargs or {})
    except Exception as error:
        raise UsageError(f"env: cannot make '{name}': {reason(error)}") from None
    check_spaces(name, env)
    return env

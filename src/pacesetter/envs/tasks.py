"""Gymnasium tasks by their id: found, made, and refused where no learner could use them."""

import logging
import re
import warnings
from dataclasses import dataclass, field
from typing import Any

import gymnasium

from pacesetter.envs.calls import call
from pacesetter.envs.spaces import check_spaces
from pacesetter.errors import TaskError, UsageError, unknown
from pacesetter.settings import Settings


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


@dataclass(frozen=True)
class Recipe:
    """How a task is made, as often as it is needed: by its Gymnasium id and keywords."""

    name: str
    kwargs: Settings = field(default_factory=dict)
    renew: bool = False  # make it anew at each episode
    timeout: float | None = None  # seconds that a call into it may take

    def make(self) -> gymnasium.Env[Any, Any]:
        """A new env. Raises UsageError if the id or the task is wrong."""
        _refuse_unknown(self.name)
        try:
            failed = f"env: cannot make '{self.name}'"
            env = call(failed, self.timeout, make_quietly, self.name, self.kwargs)
        except TaskError as error:
            raise UsageError(str(error)) from None
        check_spaces(self.name, env)
        return env


def _refuse_unknown(name: str) -> None:
    plain = name.split(":")[-1]
    if not re.search(r"-v\d+$", plain, re.IGNORECASE) and name not in known():
        versions = [known_name for known_name in known() if known_name.startswith(f"{plain}-v")]
        hint = f"; write {' or '.join(versions)}" if versions else "; such as HalfCheetah-v5"
        raise UsageError(f"env: '{name}' has no version{hint}")
    if ":" not in name and name not in known():
        raise unknown("env", name, known(), see="pacesetter list envs")

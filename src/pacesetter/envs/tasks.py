"""Gymnasium tasks by their id: made, wrapped, and refused where no learner could use them."""

import logging
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import reduce

import gymnasium

from pacesetter.envs.calls import call
from pacesetter.envs.ids import full_id, refuse_unknown, where_to_find
from pacesetter.envs.spaces import check_spaces
from pacesetter.envs.wrappers import Env, flattened, wrapped
from pacesetter.errors import TaskError, UsageError
from pacesetter.settings import Settings

Factory = Callable[..., Env]
FUNCTION = "function/"  # begins the name of a task that a function makes


def _log_warning(message: str) -> None:
    if "settotalmass" not in message:  # Gymnasium's own models; nothing a user can do
        logging.getLogger(__name__).warning("MuJoCo: %s", message)


def make_quietly(name: str, kwargs: Settings) -> Env:
    """gymnasium.make without the warnings that v4 is old and its models use an old keyword."""
    with suppress(Exception):  # of a MuJoCo that does not load, which not every task needs
        import mujoco

        # Without a handler MuJoCo writes MUJOCO_LOG.TXT into the working directory.
        mujoco.set_mju_user_warning(_log_warning)  # pyright: ignore[reportAttributeAccessIssue]
    with warnings.catch_warnings():
        for message in ("The environment .* is out of date", "Using the latest versioned"):
            warnings.filterwarnings("ignore", message=f".*{message}.*")
        return gymnasium.make(name, disable_env_checker=True, **kwargs)


def name_of(env: str | Factory) -> str:
    """The id, or a name for what a function makes."""
    if isinstance(env, str):
        return env
    own = getattr(env, "__name__", type(env).__name__)
    return FUNCTION + (re.sub(r"\W", "", own) or "env")


@dataclass(frozen=True)
class Recipe:
    """How a task is made, as often as it is needed: its Gymnasium id, keywords and wrappers."""

    name: str
    kwargs: Settings = field(default_factory=dict)
    wrap: tuple[str, ...] = ()  # module:Class, the innermost first
    renew: bool = False  # make it anew at each episode
    timeout: float | None = None  # seconds that a call into it may take
    factory: Factory | None = None  # gives a new env at each call, in the place of the id

    def make(self) -> Env:
        """A new env with Box spaces. Raises UsageError if the id or the task is wrong."""
        env = reduce(wrapped, self.wrap, self._bare())
        env = flattened(self.name, env)
        check_spaces(self.name, env)
        return env

    def _bare(self) -> Env:
        return self._registered() if self.factory is None else self._from(self.factory)

    def _from(self, factory: Factory) -> Env:
        try:
            failed = f"env: cannot make '{self.name}'"
            env: object = call(failed, self.timeout, factory, **self.kwargs)
        except TaskError as error:
            raise UsageError(str(error)) from None
        if not isinstance(env, gymnasium.Env):
            raise UsageError(f"env: {self.name} must give an env, got a {type(env).__name__}")
        return env

    def _registered(self) -> Env:
        if self.name.startswith(FUNCTION):
            raise UsageError(f"env: '{self.name}' was given as a function; give it again, as env=")
        name = full_id(self.name)
        refuse_unknown(name)
        try:
            failed = f"env: cannot make '{name}'"
            env = call(failed, self.timeout, make_quietly, name, self.kwargs)
        except TaskError as error:
            missing = isinstance(error.__cause__, ModuleNotFoundError) and ":" in name
            raise UsageError(f"{error}; {where_to_find(name)}" if missing else str(error)) from None
        module, colon, asked = name.partition(":")
        made = env.spec.id if env.spec else asked
        if colon and made != asked:
            raise UsageError(f"env: '{name}' has no version; write {module}:{made}")
        return env

"""Which policy a word of the command line means: a run's, a file's or a shipped champion's."""

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pacesetter.cli.flags import Parser, split_env_kwargs
from pacesetter.consent import require
from pacesetter.errors import UsageError
from pacesetter.files import NOT_REGULAR, is_regular, present
from pacesetter.settings import Settings

if TYPE_CHECKING:
    from pacesetter.policy import Policy

RUN = "run folder or the end of its path (its policy.safetensors), a policy file, or champion:NAME"


class Found(NamedTuple):
    """A policy, its file, and the task and keywords to play it with; a task only if it is named."""

    policy: "Policy"
    file: Path
    env: str | None
    env_kwargs: Settings
    wrap: tuple[str, ...] | None  # None where there are none

    @property
    def task(self) -> dict[str, Any]:
        """As the functions of `media` take it."""
        if self.wrap is None:
            return {"env": self.env, "env_kwargs": self.env_kwargs}
        from pacesetter.envs import Recipe

        about = self.policy.about
        name = self.env or about["env"]
        renew = bool(about.get("renew_env")) and name == about.get("env")
        return {"env": Recipe(name, self.env_kwargs, self.wrap, renew)}


def add_run(command: Parser) -> None:
    """RUN, and the flags of the task that its policy plays."""
    command.add_argument("run", metavar="RUN|FILE", help=RUN)
    command.add_argument("--env", metavar="ID", help="task to play (default the policy's own)")
    wrap = "wrappers around it, the innermost first (default the policy's own); may be repeated"
    command.add_argument(
        "--wrap", action="extend", nargs="+", default=[], metavar="MODULE:CLASS", help=wrap
    )
    command.add_env_keywords()
    command.add_allow()
    command.add_runs()


def add_seed(command: Parser) -> None:
    """`--seed`, of start states."""
    about = "seed of the start states (default 0)"
    command.add_argument("--seed", type=int, default=0, metavar="N", help=about)


def parse(command: Parser, words: list[str]) -> tuple[Namespace, Found]:
    """The flags, and the policy that RUN means."""
    from pacesetter.envs.ids import full_id
    from pacesetter.policy import load

    words, env_kwargs = split_env_kwargs(words)
    given = command.parse(words)
    if getattr(given, "seed", 0) < 0:
        raise UsageError(f"seed: must be at least 0, got {given.seed}")
    file = policy_file(given.run, given.runs)
    policy = load(file)
    own = policy.about.get("env")
    named = full_id(given.env) if given.env else None
    env = named or (own if own in given.allow else None)
    if (env or own) == own:
        env_kwargs = policy.about.get("env_kwargs", {}) | env_kwargs
    return given, Found(policy, file, env, env_kwargs, _wrap(policy.about, env, given))


def _wrap(about: dict[str, Any], env: str | None, given: Namespace) -> tuple[str, ...] | None:
    """The wrappers that the command line gives, or those of the policy's own task if it allows."""
    name = env or about.get("env")
    own = about.get("wrap", []) if name == about.get("env") else []
    if not given.wrap and not own:
        return None
    if not isinstance(name, str):
        raise UsageError("env: the policy names no env; give one with --env")
    require("env", name, [env])
    for wrapper in [] if given.wrap else own:
        require("wrap", str(wrapper), given.allow)
    return tuple(given.wrap or own)


def policy_file(run: str, runs: str) -> Path:
    """The policy file that is meant: a run's, a file itself or a shipped champion."""
    from pacesetter.policy import file_of
    from pacesetter.runs import find

    if file := file_of(run):
        return file
    found = find(run, runs)
    if not present(found.policy_file):
        raise UsageError(f"run: {found.path} has no policy yet; it comes with its first evaluation")
    if not is_regular(found.policy_file):
        raise UsageError(f"run: {found.policy_file} {NOT_REGULAR}")
    return found.policy_file

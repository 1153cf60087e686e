"""A policy as Stable-Baselines3 expects a model: an object with `predict`."""

from pathlib import Path
from typing import Any

from pacesetter.consent import require
from pacesetter.envs import Recipe
from pacesetter.envs.tasks import FUNCTION
from pacesetter.errors import UsageError, writing
from pacesetter.evaluation import recipe_of
from pacesetter.files import write_atomically
from pacesetter.policy import Floats, Policy

SCRIPT = '''"""`model` is a policy as Stable-Baselines3 expects one; run it to evaluate."""

{imports}from pathlib import Path

from pacesetter import load
from pacesetter.media.sb3 import SB3Policy

model = SB3Policy(load(Path(__file__).with_suffix(".safetensors")))

if __name__ == "__main__":
    from pacesetter.envs import Recipe
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    env = Monitor(Recipe({task}).make())
    mean, std = evaluate_policy(model, env, n_eval_episodes=10)
    print(f"return {{mean:.1f}} +- {{std:.1f}} over 10 episodes")
'''


class SB3Policy:
    """What `evaluate_policy` of Stable-Baselines3 takes for a model; needs no part of it.

    It can act; it cannot be trained on, since a policy file holds no critics and no optimiser.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def predict(
        self,
        observation: Any,
        state: tuple[Any, ...] | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Floats, tuple[Any, ...] | None]:
        """Actions in the env's units for one observation or a batch, and the state as it came.

        Policy files hold the mean action alone, so `deterministic=False` gives the same action.
        """
        return self.policy(observation), state


def to_sb3(
    policy: Policy,
    path: Path,
    *,
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> Path:
    """Write a short script that makes the `model`, and beside it the policy file, which it names.

    No SB3 .zip is written: it would have to claim critics and an optimiser that are not there.
    """
    if path.suffix != ".py":
        raise UsageError(f"sb3: {path} must end in .py")
    task = recipe_of(policy.about, env, env_kwargs)
    if not isinstance(env, Recipe):
        for kind, names in (("env", (task.name,)), ("wrap", task.wrap)):
            for name in names:
                require(kind, name, [env], loaded=())  # the script will run in another process
    if task.name.startswith(FUNCTION):
        raise UsageError(f"env: '{task.name}' was given as a function, which no script can name")
    file = path.with_suffix(".safetensors")
    for made in (path, file):
        if made.exists():
            raise UsageError(f"sb3: {made} exists; give {path.name} another name")
    given = [task.name, task.kwargs, task.wrap]
    while not given[-1]:
        given.pop()
    words = ", ".join(map(repr, given))
    odd = [name for name in ("inf", "nan") if name in words]  # as `repr` writes such numbers
    imports = f"from math import {', '.join(odd)}\n" if odd else ""
    text = SCRIPT.format(task=words, imports=imports)
    try:
        with writing("sb3", path):
            policy.save(file)
            write_atomically(path, text.encode())
    except UsageError:
        file.unlink(missing_ok=True)
        raise
    return file

"""A policy's episodes as a Minari data set, which offline learners read."""

import re
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError, reason, writing
from pacesetter.evaluation import enter
from pacesetter.extras import need
from pacesetter.media.scene import setting
from pacesetter.policy import Policy, to_env
from pacesetter.seeding import episode_seed

INSTALL = "pacesetter[minari]"
NAME = r"[-\w]+-v\d+"


def to_minari(
    policy: Policy,
    path: Path,
    *,
    episodes: int = 100,
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
) -> list[float]:
    """Write seeded episodes into the folder `path`, which must be new, and return their returns.

    Its name is the data set's id, such as cheetah-sac-v0; `minari.load_dataset(id)` finds it with
    MINARI_DATASETS_PATH set to the folder above. Observations and actions are those of the env, in
    its own units and types. Needs the extra `minari`.
    """
    _check(path, episodes)
    minari = need("minari", "minari", INSTALL)
    need("minari", "h5py", INSTALL)
    world = enter(policy, env, seed, env_kwargs)
    try:
        buffers = [_episode(policy, world, number) for number in range(episodes)]
        returns = [float(np.sum(buffer["rewards"])) for buffer in buffers]
        kind = need("minari", "minari.data_collector", INSTALL).EpisodeBuffer
        with (
            writing("minari", path),
            TemporaryDirectory(dir=path.parent.resolve()) as root,  # it joins a relative to itself
            setting("MINARI_DATASETS_PATH", root),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")  # of fields that may be left out
            minari.create_dataset_from_buffers(
                path.name,
                [kind(**buffer) for buffer in buffers],
                env=world.env if _as_json(world) else None,
                action_space=world.env.action_space,
                observation_space=world.env.observation_space,
                algorithm_name=policy.about.get("algorithm"),
                description=_describe(policy, world.name, returns, seed),
            )
            Path(root, path.name).rename(path)
    except ValueError as error:  # such as a space that it has no form for
        raise UsageError(f"minari: cannot write {path}: {reason(error)}") from None
    finally:
        world.close()
    return returns


def _episode(policy: Policy, world: Environment, number: int) -> dict[str, Any]:
    """What the env gave and took in one episode: T + 1 observations, T of all else."""
    observation, step = world.reset(number), None
    found: dict[str, Any] = {
        "id": number,
        "seed": episode_seed(world.seed, world.stream, world.index, number),
        "observations": [np.array(world.given)],
    }
    found |= {name: [] for name in ("actions", "rewards", "terminations", "truncations")}
    while step is None or not step.ended:
        action = policy.act(observation)
        step = world.step(action)
        observation = step.observation
        scaled = to_env(action, world.low, world.high).reshape(world.action_shape)
        found["observations"].append(np.array(world.given))
        found["actions"].append(scaled.astype(world.action_type))
        found["rewards"].append(step.reward)
        found["terminations"].append(step.terminated)
        found["truncations"].append(step.truncated)
    return found


def _as_json(world: Environment) -> bool:
    """Whether a data set can say how its env is made; not of one registered by a class itself."""
    try:
        return world.env.spec is not None and bool(world.env.spec.to_json())
    except (TypeError, ValueError):
        return False


def _check(path: Path, episodes: int) -> None:
    if not re.fullmatch(NAME, path.name):
        raise UsageError(f"minari: {path} must end in a name and a version, such as cheetah-v0")
    if path.exists():
        raise UsageError(f"minari: {path} exists; give another name or version")
    if not path.parent.is_dir():
        raise UsageError(f"minari: cannot write {path}: make the folder {path.parent} first")
    if episodes < 1:
        raise UsageError(f"episodes: must be at least 1, got {episodes}")


def _describe(policy: Policy, env: str, returns: list[float], seed: int) -> str:
    about = policy.about
    made = f"{about.get('algorithm', 'a policy')} after {about.get('step', 0):,} env steps"
    return (
        f"{len(returns)} episodes of {env}, seed {seed}, without noise, by {made}; mean return "
        f"{np.mean(returns):.1f}, standard deviation {np.std(returns):.1f}. Made by pacesetter."
    )

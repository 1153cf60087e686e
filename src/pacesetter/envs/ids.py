"""Ids of tasks: which there are, the newest of a name, and what to write for an unknown one."""

import re
import shlex

import gymnasium

from pacesetter.errors import UsageError, unknown

# How ids of other packages begin, the module that registers them, and the packages for pip.
PACKAGES = (
    (r"Fetch|Hand|Adroit|Franka|PointMaze|AntMaze", "gymnasium_robotics", "gymnasium-robotics"),
    (r"dm_control/", "shimmy", "shimmy[dm-control] mujoco<4"),
    (r"Meta-World/", "metaworld", "metaworld"),
    (r"Panda", "panda_gym", "panda-gym"),
    (r"(highway|merge|roundabout|parking|racetrack)-", "highway_env", "highway-env"),
    (r"myo", "myosuite", "myosuite"),
    (r"PyFlyt/", "PyFlyt.gym_envs", "PyFlyt"),
    (r"\w+BulletEnv-", "pybullet_envs_gymnasium", "pybullet_envs_gymnasium"),
)


def known() -> list[str]:
    """Ids that can be made without a module, without those whose entry point only raises."""

    def works(entry_point: object) -> bool:
        return not getattr(entry_point, "__name__", "").startswith("_raise_")

    return [name for name, spec in gymnasium.registry.items() if works(spec.entry_point)]


def full_id(name: str) -> str:
    """The id with the newest version that Gymnasium has, where one without a version has some."""
    if ":" in name or name in gymnasium.registry:
        return name
    pattern = re.compile(rf"{re.escape(name)}-v(\d+)")
    found = [(int(match[1]), match[0]) for each in known() if (match := pattern.fullmatch(each))]
    return max(found)[1] if found else name


def refuse_unknown(name: str) -> None:
    """Refuse an id that is not registered; one of a package that is known gets its module."""
    if ":" in name or name in known():
        return
    for pattern, module, packages in PACKAGES:
        if re.match(pattern, name):
            raise UsageError(
                f"env: '{name}' is a task of another package; {_install(packages)} and write "
                f"{module}:{name}"
            )
    refusal = unknown("env", name, known(), see="pacesetter list envs")
    raise UsageError(f"{refusal}; a task of another package is written module:Id-v0")


def where_to_find(name: str) -> str:
    """What to do about an id whose module is not there: install it, if it is a known one."""
    for _, module, packages in PACKAGES:
        if name.startswith(f"{module}:"):
            return _install(packages)
    return "its folder must be the current one or in PYTHONPATH"


def _install(packages: str) -> str:
    return f"`pip install {shlex.join(packages.split())}`"

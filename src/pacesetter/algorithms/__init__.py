"""The table of algorithms: a new one is one file and one line here."""

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from pacesetter.errors import UsageError, unknown


class Entry(NamedTuple):
    """Where an algorithm is and one line of what it is."""

    target: str
    help: str
    alone: bool = False  # it trains one member only


TABLE = {
    "td3": Entry("pacesetter.algorithms.td3", "twin delayed DDPG (Fujimoto et al. 2018)"),
    "sac": Entry("pacesetter.algorithms.sac", "soft actor-critic, temperature learned"),
    "crossq": Entry(
        "pacesetter.algorithms.crossq", "SAC with batch renorm and no targets (Bhatt et al. 2024)"
    ),
    "sunrise": Entry(
        "pacesetter.algorithms.sunrise", "an ensemble of SAC learners (Lee et al. 2021)"
    ),
    "sunrise-td3": Entry("pacesetter.algorithms.sunrise_td3", "SUNRISE's ensemble over TD3"),
    "steve": Entry("pacesetter.algorithms.steve", "DDPG with targets from learned models"),
    "steve-td3": Entry("pacesetter.algorithms.steve_td3", "TD3 with targets from learned models"),
    "ddpg": Entry("pacesetter.algorithms.ddpg", "TD3 with its three tricks off"),
    "trpo": Entry("pacesetter.algorithms.trpo", "trust region policy optimisation", True),
    "me-trpo": Entry("pacesetter.algorithms.me_trpo", "TRPO in an ensemble of models", True),
}


class Kind(NamedTuple):
    """An algorithm before it knows its task: its settings class and `build(spec, hyper)`."""

    Hyper: type
    build: Callable[..., Any]


def plugins() -> dict[str, str]:
    """Algorithms that other installed packages declare under `pacesetter.algorithms`."""
    return {point.name: point.value for point in entry_points(group="pacesetter.algorithms")}


def names() -> list[str]:
    """All names that `find` knows."""
    return [*TABLE, *plugins()]


def alone(name: str) -> bool:
    """Whether there is no `multi-` form of an algorithm."""
    return name in TABLE and TABLE[name].alone


def find(name: str) -> Kind:
    """The algorithm by name, or by `package.module:Class` with a class attribute `Hyper`."""
    found = {key: entry.target for key, entry in TABLE.items()} | plugins()
    target = name if ":" in name else found.get(name)
    if target is None:
        raise unknown("algorithm", name, found)
    path, _, attribute = target.partition(":")
    try:
        module: Any = import_module(path)
        if not attribute:
            return Kind(module.Hyper, module.build)
        found_class = getattr(module, attribute)
        return Kind(found_class.Hyper, found_class)
    except Exception as error:
        raise UsageError(f"algorithm: cannot load '{target}': {error}") from None

"""The table of algorithms: a new one is one file and one line here."""

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from pacesetter.errors import UsageError, unknown
from pacesetter.settings import OffPolicy, OnPolicy


class Entry(NamedTuple):
    """Where an algorithm's class is and one line of what it is."""

    target: str
    help: str
    single_member: bool = False  # it trains one member only


def _shipped(target: str, help: str, single_member: bool = False) -> Entry:
    return Entry(f"pacesetter.algorithms.{target}", help, single_member)


TABLE = {
    "td3": _shipped("td3:TD3", "twin delayed DDPG (Fujimoto et al. 2018)"),
    "td7": _shipped("td7:TD7", "TD3 with learned embeddings, LAP, checkpoints"),
    "sac": _shipped("sac:SAC", "soft actor-critic, temperature learned"),
    "tqc": _shipped("tqc:TQC", "SAC whose target drops the largest of many quantiles"),
    "crossq": _shipped("crossq:CrossQ", "SAC with batch renorm and no targets (Bhatt et al. 2024)"),
    "sunrise": _shipped("sunrise:Sunrise", "an ensemble of SAC learners (Lee et al. 2021)"),
    "sunrise-td3": _shipped("sunrise_td3:SunriseTD3", "SUNRISE's ensemble over TD3"),
    "steve": _shipped("steve:STEVE", "DDPG with targets from learned models"),
    "steve-td3": _shipped("steve_td3:SteveTD3", "TD3 with targets from learned models"),
    "ddpg": _shipped("ddpg:DDPG", "TD3 with its three tricks off"),
    "trpo": _shipped("trpo:TRPO", "trust region policy optimisation", True),
    "me-trpo": _shipped("me_trpo:METRPO", "TRPO in an ensemble of models", True),
}


def plugins() -> dict[str, str]:
    """Algorithms that other installed packages declare under `pacesetter.algorithms`."""
    return {point.name: point.value for point in entry_points(group="pacesetter.algorithms")}


def names() -> list[str]:
    """All names that `find` knows."""
    return [*TABLE, *plugins()]


def multi_names() -> dict[str, str]:
    """`multi-NAME` and the algorithm of which it is several members."""
    return {f"multi-{name}": name for name in names() if not single_member(name)}


def single_member(name: str) -> bool:
    """Whether there is no `multi-` form of an algorithm."""
    return name in TABLE and TABLE[name].single_member


def find(name: str) -> type[Any]:
    """The learner class by name, or by `package.module:Class`; see `contract.Learner`."""
    found = {key: entry.target for key, entry in TABLE.items()} | plugins()
    target = name if ":" in name else found.get(name)
    if target is None:
        raise unknown("algorithm", name, found)
    path, _, attribute = target.partition(":")
    try:
        learner: Any = getattr(import_module(path), attribute)
        hyper: Any = learner.Hyper
        if not (isinstance(hyper, type) and issubclass(hyper, OffPolicy | OnPolicy)):
            raise TypeError("its attribute Hyper must derive from settings.OffPolicy or OnPolicy")
    except (Exception, SystemExit) as error:
        raise UsageError(f"algorithm: cannot load '{target}': {error}") from None
    return learner

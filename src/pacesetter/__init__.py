"""Train ensembles of agents that learn to walk, and prove what the ensemble is worth."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pacesetter.evaluation import evaluate
    from pacesetter.policy import load
    from pacesetter.study.compare.comparison import compare
    from pacesetter.training.trainer import Trainer

__all__ = ["Trainer", "compare", "evaluate", "load"]
_HOMES = {
    "Trainer": "pacesetter.training.trainer",
    "evaluate": "pacesetter.evaluation",
    "load": "pacesetter.policy",
    "compare": "pacesetter.study.compare.comparison",
}


def __getattr__(name: str) -> Any:
    """Import lazily, so that a policy file is used without JAX."""
    from importlib import import_module

    if name == "__version__":
        return import_module("importlib.metadata").version("pacesetter")
    if name not in _HOMES:
        raise AttributeError(f"module 'pacesetter' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The public names, so that Tab finds what is not imported yet."""
    return [*__all__, "__version__"]

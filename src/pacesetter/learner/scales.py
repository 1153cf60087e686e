"""What may differ between the members of one compiled program: factors of settings, by name.

The factor of a learning rate or of exploration noise multiplies it. That of gamma multiplies
1 - gamma, so that whatever the factor, gamma stays below 1. Factors are data: an argument of the
compiled update, so that it is compiled once for all members.
"""

import copy
from typing import Any


def value_of(name: str, base: Any, scale: Any) -> Any:
    """A setting's value, from its factor."""
    return 1 - (1 - base) * scale if name == "gamma" else base * scale


def scale_of(name: str, base: float, value: float) -> float:
    """The inverse of `value_of`."""
    return (1 - value) / (1 - base) if name == "gamma" else value / base


def scaled(learner: Any, scales: dict[str, Any]) -> Any:
    """The learner with its settings scaled by factors, which may be traced."""
    hyper = copy.copy(learner.hyper)
    for name, scale in scales.items():  # it is frozen, and checked
        object.__setattr__(hyper, name, value_of(name, getattr(hyper, name), scale))
    return learner.build(learner.spec, hyper)

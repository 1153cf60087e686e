"""Learners of a small task, and states of them that no run made."""

from typing import Any

import jax
import numpy as np
from numeric import KEY, SPEC

from pacesetter import algorithms
from pacesetter.batch import Spec
from pacesetter.dynamics.model import Models

NETWORKS = ("actor", "critic", "target_actor", "target_critic")


def learner(name: str = "td3", spec: Spec = SPEC, **hyper: Any) -> Any:
    """A learner by the name of its algorithm, with small networks unless told."""
    kind = algorithms.find(name)
    return kind.build(spec, kind.Hyper(**{"hidden": (12, 10), **hyper}))


def fresh(algorithm: Any, seed: int = 0) -> Any:
    """A state with random networks, targets unlike them, and an optimiser that has not moved.

    Without `init`, which takes long to compile.
    """
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(algorithm.init, KEY)
    state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)

    def draw(x: Any) -> Any:
        return rng.normal(size=x.shape, scale=0.5).astype(x.dtype)

    state = state._replace(**{n: jax.tree.map(draw, getattr(state, n)) for n in NETWORKS})
    if not hasattr(state, "models"):
        return state
    networks, scale = state.models
    scale = scale._replace(variance=scale.variance + 1)
    return state._replace(models=Models(jax.tree.map(draw, networks), scale))

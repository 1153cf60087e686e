"""Trees of arrays as the flat, named arrays of a checkpoint, and back."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from pacesetter.policy import Policy
from pacesetter.types import Arrays


def flatten(tree: Any) -> Arrays:
    """Every leaf of a tree under its path."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): np.asarray(leaf) for path, leaf in leaves}


def rebuild(like: Any, arrays: Arrays) -> Any:
    """The inverse of `flatten` for a tree of the same shapes; a ValueError names what differs."""

    def find(path: Any, leaf: Any) -> Any:
        array = arrays[_name(path)]
        if array.shape != leaf.shape or array.dtype != leaf.dtype:
            raise ValueError(f"{_name(path)} is {array.shape}, expected {leaf.shape}")
        return array

    return jax.tree_util.tree_map_with_path(find, like)


def policy_tree(policy: Policy) -> Any:
    """The arrays of a policy that are learned."""
    return policy.actors, policy.normalizer


def rebuilt_policy(like: Policy, arrays: Arrays) -> Policy:
    """A policy like another, with the arrays of `policy_tree`."""
    actors, normalizer = rebuild(policy_tree(like), arrays)
    return replace(like, actors=actors, normalizer=normalizer)


def below(prefix: str, arrays: Arrays) -> Arrays:
    """The arrays whose names start with a prefix and a dot, without them."""
    start = f"{prefix}."
    return {name.removeprefix(start): x for name, x in arrays.items() if name.startswith(start)}


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")

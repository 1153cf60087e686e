"""The states of K learners of one compiled program, and their updates at the same time."""

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter.algorithms.contract import State
from pacesetter.errors import TrainingError
from pacesetter.learner.compiled import CompiledLearner, MemberUpdate, UpdateInputs
from pacesetter.learner.tree_arrays import flatten, rebuild
from pacesetter.process import threads
from pacesetter.seeding import Stream, generator
from pacesetter.types import DIVERGED, DIVERGENCE, Arrays, worst


class Learners:
    """K states, what each acts with, and the stream that chooses each one's minibatches."""

    def __init__(
        self, compiled: CompiledLearner, members: int, seed: int, same: bool = False
    ) -> None:
        """`same` gives every member the same first weights."""
        self.compiled = compiled
        self.loss_names: list[str] = []  # in the order of losses, known from the first update on
        self.replace(compiled.init(members, same))
        self.sample_streams = [generator(seed, Stream.SAMPLE, k) for k in range(members)]
        self.workers = ThreadPoolExecutor(min(members, threads()))

    def replace(self, states: list[State]) -> None:
        """Go on from other states."""
        self.states = [self.compiled.blinded(state) for state in states]
        self.policy_params = self.compiled.policy_params(self.states)

    def update(self, members: Sequence[int], inputs: Sequence[UpdateInputs]) -> list[MemberUpdate]:
        """One call of the update of each of these members."""
        if not self.loss_names:
            self.loss_names = self.compiled.loss_names(self.states[members[0]], inputs[0])

        def one(k: int, given: UpdateInputs) -> MemberUpdate:
            return self.compiled.update(self.states[k], k, given)

        run = map if len(members) == 1 else self.workers.map
        results = list(run(one, members, inputs))
        for k, result in zip(members, results, strict=True):
            self.states[k] = result.state
            self.policy_params[k] = jax.tree.map(np.asarray, result.policy_params)
        return results

    def refuse_faults(self, members: Iterable[int], step: int) -> None:
        """Stop a run whose weights or moments are not finite, or soon will not be."""
        for k in members:
            for name, array in flatten(self.states[k]).items():
                if (found := worst(array, DIVERGED)) is not None:
                    raise TrainingError(
                        f"member {k}, step {step}: {name} holds {found}; {DIVERGENCE}"
                    )

    def ledger(self, updates: int, actions: int) -> dict[str, int]:
        """What so many updates and actions cost besides the members' own."""
        return self.compiled.learner.ledger(self.states, updates, actions)

    def arrays(self) -> Arrays:
        return flatten(self.states)

    def table(self) -> dict[str, Any]:
        return {"sample_streams": [rng.bit_generator.state for rng in self.sample_streams]}

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `arrays` and `table`."""
        self.replace(jax.tree.map(jnp.array, rebuild(self.states, arrays)))
        for rng, state in zip(self.sample_streams, table["sample_streams"], strict=True):
            rng.bit_generator.state = state

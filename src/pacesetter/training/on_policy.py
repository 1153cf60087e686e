"""On-policy learning: one tick is one iteration, a rollout and one update from it.

all envs are stepped in turn, with one policy and frozen statistics     collect
one update from the whole rollout, then its observations join them      learn

A checkpoint falls between iterations, so it holds no rollout: only running episodes.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pacesetter import algorithms
from pacesetter.algorithms.contract import Learner
from pacesetter.batch import Layout, Spec, Transition
from pacesetter.config import Config
from pacesetter.dynamics import known_rewards
from pacesetter.ensemble.progress import Progress
from pacesetter.envs import Environment
from pacesetter.errors import TrainingError, blame
from pacesetter.learner.compiled import Population
from pacesetter.learner.normalizer import Normalizer, Statistics
from pacesetter.policy import Policy, clip, normalize
from pacesetter.replay.buffer import Replay
from pacesetter.replay.n_step import NStepQueue
from pacesetter.seeding import Stream, generator
from pacesetter.settings import ModelDriven
from pacesetter.training.sources import AllSteps, LastRollout
from pacesetter.types import Floats


class Iterations:
    """One learner and its envs; to the trainer and the checkpoint what `Ensemble` is.

    `progress.members` are here the episodes that run, one an env.
    """

    def __init__(self, config: Config, envs: list[Environment]) -> None:
        run, hyper, first = config.run, config.hyper, envs[0]
        self.config, self.envs = config, envs
        spec = Spec(first.observation_size, first.action_size)
        build = algorithms.find(run.algorithm).build
        if isinstance(hyper, ModelDriven) and hyper.known:
            build = partial(build, known=known_rewards.of(run.env, run.env_kwargs))
        self.algorithm: Learner = build(spec, hyper)
        self.streams = [generator(run.seed, Stream.ACT, k) for k in range(len(envs))]
        self.layout = Layout(spec)
        self.population = Population(
            self.algorithm, self.layout, run.seed, hyper.normalize_observation
        )
        self.states = self.population.init(1, same=False)
        self.acting = self.population.policy_params(self.states)
        source = AllSteps if isinstance(hyper, ModelDriven) else LastRollout
        self.source: AllSteps | LastRollout = source(config, self.layout)
        self.loss_names = self.population.loss_names(self.states[0], *self.source.shape())
        self.normalizer = Normalizer(spec.observation_size)
        self.budget = run.steps
        self.pending: list[NStepQueue] = []
        self.kept: list[Policy | None] = [None]  # nothing is assessed
        self.memory = [self.algorithm.start_episode(self.acting[0], rng) for rng in self.streams]
        self.progress = Progress.of(len(envs))

    def open_replays(self, folder: Path) -> None:
        """Make or find the ring, if steps are kept."""
        self.source.open(folder / "replay-0.bin", self.budget)

    @property
    def replays(self) -> list[Replay]:
        """The ring, if there is one."""
        return self.source.replays

    behind = False  # an iteration makes its update

    def tick(self) -> None:
        """One iteration; what is left of the budget at the end is too little to learn from."""
        size = self.config.hyper.rollout_length * len(self.envs)
        rows = self.collect(min(size, self.budget - self.progress.step))
        self.source.keep(rows)
        if len(rows) == size:
            self.learn(rows)
        self.progress.tick += 1

    def close(self) -> None:
        """Let go of envs and files."""
        for env in self.envs:
            env.close()
        self.source.close()

    @property
    def statistics(self) -> Statistics:
        """What observations are normalised by, now."""
        return self.normalizer.statistics()

    def ledger(self) -> dict[str, Any]:
        """What the run has spent."""
        progress = self.progress
        actions = sum(member.actions for member in progress.members)
        extra = self.algorithm.ledger(self.states, progress.updates, actions)
        return progress.ledger() | {"member_steps": [progress.step]} | extra

    def policy(self, member: int) -> Policy:
        """The policy as it is now."""
        return self.population.policy(self.states[member], self.envs[0], self.statistics)

    current = policy

    def abandon(self, k: int) -> None:
        """Begin a new episode in an env whose own cannot be repeated."""
        self.progress.members[k].abandon()

    # Collect.

    def collect(self, steps: int) -> Floats:
        """Rows (steps, width) of that many steps, the envs in turn."""
        rows = np.empty((steps, self.layout.width), np.float32)
        statistics = self.statistics
        for i in range(steps):
            k = i % len(self.envs)
            with blame(k, self.progress.step, "env"):
                rows[i] = self._step(k, statistics)
        return rows

    def _step(self, k: int, statistics: Statistics) -> Floats:
        """The row of one step of env k; the action stays uncut, so that its density is known."""
        progress, member, env = self.progress, self.progress.members[k], self.envs[k]
        if member.starting:
            env.reset()
            member.start(progress.step)
            self.memory[k] = self.algorithm.start_episode(self.acting[0], self.streams[k])
        before = seen = env.observation
        if self.population.normalize:
            seen = normalize(before, *statistics)
        action, self.memory[k] = self.algorithm.act(
            self.acting[0], self.memory[k], seen, self.streams[k]
        )
        if not np.isfinite(action).all():
            raise TrainingError(f"action is not finite: {action}")
        step = env.step(clip(action))
        member.step(step.reward)
        member.actions += 1
        if step.ended:
            progress.episodes += 1
            progress.ended.append([0, member.episode_return, member.episode_length])
            member.starting = True
        discount = self.config.hyper.gamma * (1.0 - step.terminated)
        mask = np.zeros(0, np.float32)
        return self.layout.pack(
            Transition(before, action, step.reward, step.observation, discount, step.ended, mask)
        )

    # Learn.

    def learn(self, rows: Floats) -> None:
        """One update after a rollout, whose rows (steps, width) then join the statistics."""
        progress = self.progress
        data, extra = self.source.data(rows, progress.updates)
        result = self.population.update(
            self.states[0], 0, progress.updates, data, None, self.statistics, extra
        )
        self.states = [result.state]
        for name, loss in zip(self.loss_names, np.asarray(result.losses), strict=True):
            if not np.isfinite(loss):
                raise TrainingError(f"step {progress.step}: {name} is {loss}")
        progress.note(np.asarray(result.losses))
        self.acting = [jax.tree.map(np.asarray, result.acting)]
        progress.updates += 1
        progress.transitions += int(extra.get("valid", len(rows)))
        if self.population.normalize:
            for row in self.layout.unpack(rows).observation:
                self.normalizer.add(row)

"""On-policy learning: one tick is one iteration, a rollout and one update from it.

all envs are stepped in turn, with one policy and frozen statistics     collect
one update from the whole rollout, then its observations join them      learn

A checkpoint falls between iterations, so it holds no rollout: only running episodes.
"""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pacesetter import algorithms
from pacesetter.batch import Layout, Spec, Transition
from pacesetter.config import Config
from pacesetter.dynamics import known_rewards
from pacesetter.ensemble.explorer import Explorer
from pacesetter.ensemble.loop import Part, numbered
from pacesetter.ensemble.progress import Progress
from pacesetter.envs import Environment
from pacesetter.errors import blame
from pacesetter.learner.compiled import CompiledLearner, UpdateInputs
from pacesetter.learner.learners import Learners
from pacesetter.learner.normalizer import Normalizer
from pacesetter.policy import Policy
from pacesetter.replay.buffer import Replay
from pacesetter.settings import ModelDriven
from pacesetter.training.sources import AllSteps, LastRollout
from pacesetter.types import Floats


class OnPolicyLoop:
    """One learner that explores several envs: the `Loop` of on-policy learning."""

    has_due_updates = False  # an iteration makes its update
    whole = True

    def __init__(self, config: Config, envs: list[Environment]) -> None:
        run, hyper, first = config.run, config.hyper, envs[0]
        self.config, self.budget = config, config.budget
        spec = Spec(first.observation_size, first.action_size)
        build = algorithms.find(run.algorithm).build
        if isinstance(hyper, ModelDriven) and hyper.known:
            build = partial(build, known=known_rewards.of(run.env, run.env_kwargs))
        learner = build(spec, hyper)
        self.layout = Layout(spec)
        self.normalizer = Normalizer(spec.observation_size, hyper.normalize_observation)
        compiled = CompiledLearner(learner, self.layout, run.seed, self.normalizer.enabled)
        self.learners = Learners(compiled, 1, run.seed)
        params = self.learners.policy_params[0]
        self.explorers = [Explorer(learner, env, params, run.seed, i) for i, env in enumerate(envs)]
        source = AllSteps if isinstance(hyper, ModelDriven) else LastRollout
        self.source: AllSteps | LastRollout = source(config, self.layout, first.recipe)
        self.progress = Progress.of(1)

    def open_replays(self, folder: Path) -> None:
        """Make or find the ring, if steps are kept."""
        self.source.open(folder / "replay-0.bin", self.budget)

    @property
    def replays(self) -> list[Replay]:
        """The ring, if there is one."""
        return self.source.replays

    def tick(self) -> None:
        """One iteration; what is left of the budget at the end is too little to learn from."""
        size = self.config.hyper.rollout_length * len(self.explorers)
        self.whole = False
        rows = self.collect(min(size, self.budget - self.progress.step))
        self.source.keep(rows)
        if len(rows) == size:
            self.learn(rows)
        self.progress.tick += 1
        self.whole = True

    def close(self) -> None:
        """Let go of envs, files and threads."""
        with ExitStack() as stack:
            for each in (self.source, *(e.env for e in self.explorers)):
                stack.callback(each.close)
            self.learners.workers.shutdown()

    def training_values(self) -> dict[str, Any]:
        """How training went since this was last called."""
        return self.progress.training_values()

    def policy(self, member: int) -> Policy:
        """The policy as it is now."""
        return self.explorers[0].policy(self.learners.states[member], self.normalizer)

    def averaged(self, champion: Policy) -> dict[str, list[Policy]]:
        """None: there is one member."""
        return {}

    def keep_snapshot(self, champion: Policy) -> None:
        """There is nothing to keep."""

    def collect(self, steps: int) -> Floats:
        """Rows (steps, width) of that many steps, the envs in turn."""
        rows = np.empty((steps, self.layout.width), np.float32)
        for t in range(steps):
            i = t % len(self.explorers)
            with blame(i, self.progress.step, "env"):
                rows[t] = self.layout.pack(self._step(self.explorers[i]))
        return rows

    def _step(self, explorer: Explorer) -> Transition:
        """One step; the action stays unclipped, so that its probability is known."""
        progress, params = self.progress, self.learners.policy_params[0]
        if explorer.starting:
            explorer.start(params, progress.step)
        action = explorer.act(params, self.normalizer.scale(explorer.env.observation), {})
        transition = explorer.step(action, self.config.hyper.gamma, clipped=False)
        progress.members[0].steps += 1
        progress.members[0].actions += 1
        if transition.last:
            progress.end_episode(0, explorer.env.earned, len(explorer.env.actions))
            explorer.starting = True
        return transition

    def learn(self, rows: Floats) -> None:
        """One update after a rollout, whose observations then join the statistics."""
        progress = self.progress
        data, extra = self.source.data(rows, progress.updates)
        statistics = self.normalizer.statistics()
        inputs = UpdateInputs(progress.updates, data, None, statistics, extra)
        (result,) = self.learners.update([0], [inputs])
        progress.add_losses(self.learners.loss_names, result.losses, 0)
        self.learners.refuse_faults([0], progress.step)
        progress.updates += 1
        progress.transitions += int(extra.get("valid", len(rows)))
        for observation in self.layout.unpack(rows).observation:
            self.normalizer.add(observation)

    def parts(self) -> dict[str, Part]:
        """What a checkpoint holds; envs come last, because they step when they are restored."""
        return {
            "states": self.learners,
            "normalizer": self.normalizer,
            "progress": self.progress,
            **numbered("replay", self.replays),
            **numbered("env", self.explorers),
        }

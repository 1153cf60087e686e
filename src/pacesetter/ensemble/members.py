"""The members at work: their learners, envs, replay and random streams, and one tick of them.

members that are in an episode act and step their envs          collect
members that owe enough updates make them on their own batches  learn
when the round is over, all start again from the rule's choice  turn
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pacesetter import algorithms
from pacesetter.algorithms.contract import Learner
from pacesetter.batch import Layout, Spec, Transition
from pacesetter.config import Config
from pacesetter.ensemble import selection as selections
from pacesetter.ensemble.copying import copy_from_parents
from pacesetter.ensemble.progress import Member, Progress
from pacesetter.ensemble.rules import Parents
from pacesetter.ensemble.selection import Selection
from pacesetter.envs import Environment
from pacesetter.errors import TrainingError, blame
from pacesetter.learner.compiled import Cycle, Population
from pacesetter.learner.normalizer import Normalizer, Statistics
from pacesetter.policy import Policy, clip, normalize
from pacesetter.process import threads
from pacesetter.replay.buffer import Replay, Sample, make_sampler
from pacesetter.replay.n_step import NStepQueue
from pacesetter.seeding import Stream, generator
from pacesetter.types import Floats

LONGEST = 500  # cycles a member and tick, so that a run can be stopped and saved between them
ASSESS_AFTER = 750_000  # updates (TD7)


class Ensemble:
    """Everything that a run trains and trains on; what of it must survive is in checkpoint.py."""

    def __init__(self, config: Config, envs: list[Environment]) -> None:
        run, hyper, first = config.run, config.hyper, envs[0]
        self.config, self.envs = config, envs
        spec = Spec(first.observation_size, first.action_size)
        self.algorithm: Learner = algorithms.find(run.algorithm).build(spec, hyper)
        masks = len(self.algorithm.mask(generator(0, Stream.MASK)))
        self.layout = layout = Layout(spec, masks)
        self.population = Population(
            self.algorithm, layout, run.seed, hyper.normalize_observation, hyper.precision
        )
        self.states = self.population.init(run.members, run.same_init)
        self.acting = self.population.policy_params(self.states)
        self.loss_names = self.population.loss_names(self.states[0])
        self.normalizer = Normalizer(spec.observation_size)
        self.unchanged = self.normalizer.statistics()
        self.budget = run.steps * config.unit
        self.horizon = (hyper.replay_horizon or 0) * config.unit  # 0 where there are no weights
        self.replays: list[Replay] = []
        self.workers = ThreadPoolExecutor(min(run.members, threads()))
        self.pending = [NStepQueue(hyper.n_step) for _ in range(run.members)]
        self.kept: list[Policy | None] = [None] * run.members  # the best assessed policies
        self.warmup_streams = [generator(run.seed, Stream.WARMUP, k) for k in range(run.members)]
        self.act_streams = [generator(run.seed, Stream.ACT, k) for k in range(run.members)]
        self.sample_streams = [generator(run.seed, Stream.SAMPLE, k) for k in range(run.members)]
        self.mask_streams = [generator(run.seed, Stream.MASK, k) for k in range(run.members)]
        self.rule_stream = generator(run.seed, Stream.RULE)
        spare = generator(run.seed, Stream.ACT)
        self.memory = [self.algorithm.start_episode(acting, spare) for acting in self.acting]
        self.progress = Progress.of(run.members)
        every = run.select_every * config.unit
        self.progress.next_selection = (config.select_after // every + 1) * every
        self.trial_env: Environment | None = None

    def open_replays(self, folder: Path) -> None:
        """Make or find the rings, whose files take their whole space at once."""
        count = 1 if self.config.run.replay_scope == "shared" else self.config.run.members
        size = self.config.hyper.replay_size
        for i in range(count):
            path = folder / f"replay-{i}.bin"
            sampler = make_sampler(self.config.hyper, min(size, self.budget))
            self.replays.append(Replay(path, self.layout, size, self.budget, sampler))

    @property
    def streams(self) -> list[np.random.Generator]:
        """All random streams, in the order of the checkpoint."""
        each = (self.warmup_streams, self.act_streams, self.sample_streams, self.mask_streams)
        return [*(rng for streams in each for rng in streams), self.rule_stream]

    def tick(self) -> Selection | None:
        """One tick; the selection, if it made one."""
        self.collect()
        self.learn()
        selection = self.turn()
        self.progress.tick += 1
        return selection

    def close(self) -> None:
        """Let go of envs, files and threads."""
        self.workers.shutdown()
        for env in (*self.envs, self.trial_env):
            if env is not None:
                env.close()
        for replay in self.replays:
            replay.close()

    @property
    def behind(self) -> bool:
        """Whether updates are due that did not fit into the last tick."""
        return any(self._ready(k) for k, _ in self.progress.each())

    @property
    def statistics(self) -> Statistics:
        """What observations are normalised by, now."""
        return self.normalizer.statistics() if self.population.normalize else self.unchanged

    def ledger(self) -> dict[str, Any]:
        """What the run has spent."""
        progress = self.progress
        actions = sum(member.actions for member in progress.members)
        return progress.ledger() | self.algorithm.ledger(self.states, progress.updates, actions)

    def policy(self, member: int) -> Policy:
        """A member's policy: the best that was assessed, if any was, or as it is now."""
        kept = self.kept[member]
        return self.current(member) if kept is None else replace(kept, about=dict(kept.about))

    def current(self, member: int) -> Policy:
        """A member's policy as it is now."""
        return self.population.policy(self.states[member], self.envs[0], self.statistics)

    def replay(self, k: int) -> Replay:
        """The replay of a member: the shared one, or its own."""
        return self.replays[k % len(self.replays)]

    # Collect.

    def collect(self) -> None:
        """Every member in an episode that is not behind with its updates acts and steps its own
        env, up to the budget.
        """
        progress, warmup = self.progress, self.config.hyper.warmup
        for k, member in progress.each():
            if member.starting:
                self._start(k, member)
        acting = [k for k, member in progress.each() if member.active and not self._ready(k)]
        for k in acting[: self.budget - progress.step]:
            action = self._random(k) if progress.step < warmup else self._explore(k)
            with blame(k, progress.step):
                self._step(k, action)

    def _start(self, k: int, member: Member) -> None:
        with blame(k, self.progress.step):
            self.envs[k].reset()
        member.start(self.progress.step)
        member.assessment.over = False
        self.memory[k] = self.algorithm.start_episode(self.acting[k], self.act_streams[k])

    def _random(self, k: int) -> Floats:
        size = self.envs[k].action_size
        return self.warmup_streams[k].uniform(-1, 1, size).astype(np.float32)

    def _explore(self, k: int) -> Floats:
        observation, rng = self.envs[k].observation, self.act_streams[k]
        if self.population.normalize:
            observation = normalize(observation, *self.statistics)
        acting, memory = self.acting[k], self.memory[k]
        action, self.memory[k] = self.algorithm.act(acting, memory, observation, rng)
        self.progress.members[k].actions += 1
        return action

    def _step(self, k: int, action: Floats) -> None:
        progress, member, env = self.progress, self.progress.members[k], self.envs[k]
        hyper = self.config.hyper
        if not np.isfinite(action).all():
            raise TrainingError(f"action is not finite: {action}")
        before, action = env.observation, clip(action)
        step = env.step(action)
        discount = hyper.gamma * (1.0 - step.terminated)
        mask = self.algorithm.mask(self.mask_streams[k])
        transition = Transition(
            before,
            action,
            step.reward,
            step.observation,
            discount,
            step.ended,
            mask,
            earned=member.episode_return,
        )
        for row in self.pending[k].push(transition):
            self.replay(k).add(row, k)
        if self.population.normalize:
            self.normalizer.add(before)
        member.step(step.reward)
        if progress.step > hyper.warmup or hyper.warmup_updates:
            member.owed += hyper.updates_per_step
        if step.ended:
            self._end(k)

    def _end(self, k: int) -> None:
        run, progress, member = self.config.run, self.progress, self.progress.members[k]
        progress.episodes += 1
        progress.ended.append([k, member.episode_return, member.episode_length])
        self.replay(k).sampler.end(k, member.episode_return)
        learned = member.started >= self.config.hyper.warmup
        selects = run.members > 1 and run.select_on == "train"
        begun = max(self.config.select_after, member.copied)
        member.end(counts=selects and member.started >= begun)
        if self.config.hyper.assess and learned:
            self._assess(k, member)

    def _assess(self, k: int, member: Member) -> None:
        """Whether a fixed policy is kept, dropped, or assessed further before it learns on."""
        hyper, step = self.config.hyper, self.progress.step
        after = ASSESS_AFTER if hyper.assess_after is None else hyper.assess_after
        long = member.cycles * self.algorithm.updates_per_call >= after
        verdict = member.assessment.add(member.episode_return, long, hyper.assess)
        if verdict is not None:
            self.progress.assessed.append([k, verdict])
        if verdict:
            about = {"kept_at": step, "worst_return": member.assessment.best}
            self.kept[k] = replace(self.current(k), about=about)

    def abandon(self, k: int) -> None:
        """Give up a running episode that cannot be entered again; its rows stay."""
        for row in self.pending[k].flush():
            self.replay(k).add(row, k)
        self.replay(k).sampler.end(k, None)
        self.progress.members[k].abandon()

    # Learn.

    def learn(self) -> None:
        """Every member that owes a cycle of updates makes it, on its own minibatches."""
        for _ in range(LONGEST):
            members = [k for k in range(self.config.run.members) if self._ready(k)]
            if not members:
                break
            self._update(members)

    def _ready(self, k: int) -> bool:
        hyper, member = self.config.hyper, self.progress.members[k]
        if member.owed < self.algorithm.updates_per_call or not len(self.replay(k)):
            return False
        if member.steps % hyper.block or (hyper.update_at == "episode" and member.active):
            return False
        return not hyper.assess or member.assessment.over

    def _update(self, members: list[int]) -> None:
        """A cycle of every member, at the same time."""
        samples = [self._draw(k) for k in members]
        run = map if len(members) == 1 else self.workers.map
        cycles = list(run(self._cycle, members, samples))
        for k, sample, cycle in zip(members, samples, cycles, strict=True):
            self.states[k] = cycle.state
            self._check(k, cycle.losses)
            self.progress.note(cycle.losses)
            self.replay(k).feedback(sample.numbers, np.asarray(cycle.error))
            self.acting[k] = jax.tree.map(np.asarray, cycle.acting)
            self.progress.members[k].cycles += 1

    def _draw(self, k: int) -> Sample:
        progress, cycle = self.progress, self.algorithm.updates_per_call
        shape = (cycle, self.config.hyper.batch_size)
        progress.members[k].owed -= cycle
        progress.updates += cycle
        progress.transitions += shape[0] * shape[1]
        done = self._done() if self.horizon else 1.0
        return self.replay(k).sample(self.sample_streams[k], shape, done)

    def _cycle(self, k: int, sample: Sample) -> Cycle:
        return self.population.update(
            self.states[k],
            k,
            self.progress.members[k].cycles,
            sample.rows,
            sample.weight,
            self.statistics,
        )

    def _done(self) -> float:
        """Share of the horizon that has passed, over which importance weights become whole."""
        return min(self.progress.step / self.horizon, 1.0)

    def _check(self, k: int, losses: Floats) -> None:
        for name, loss in zip(self.loss_names, losses.tolist(), strict=True):
            if not isfinite(loss):
                raise TrainingError(f"member {k}, step {self.progress.step}: {name} is {loss}")

    # Turn.

    def turn(self) -> Selection | None:
        """Select where a round or an interval is over; send on the members that waited."""
        run, progress = self.config.run, self.progress
        ended = [member for member in progress.members if not member.active]
        over = len(ended) == run.members if run.wait else bool(ended)
        if over and any(self._ready(k) for k, member in progress.each() if not member.active):
            return None  # so many updates that they take several ticks
        selection = None
        if run.members > 1 and run.select_on == "eval":
            selection = selections.on_trials(self)
        elif run.members > 1 and over:
            selection = selections.on_training(self)
        if over:
            for member in ended:
                member.starting = True
        return selection

    def descend(self, parents: Parents) -> None:
        """Every member starts again from its parent, and from what was found of its policy."""
        self.states = copy_from_parents(self.algorithm, self.states, parents, self.config.run.copy)
        self.acting = self.population.policy_params(self.states)
        self.kept = [self.kept[parent] for parent in parents]
        for k, parent in enumerate(parents):
            if parent != k:  # what it earned so far in a running episode was not its new weights'
                self.progress.members[k].copied = self.progress.step
        assessments = [self.progress.members[parent].assessment.copy() for parent in parents]
        for member, assessment in zip(self.progress.members, assessments, strict=True):
            member.assessment = replace(assessment, over=member.assessment.over)

"""The members at work: their learners, envs, replay and random streams, and one tick of them.

members that are in an episode act and step their envs          collect
members that owe enough updates make them on their own batches  learn
when the round is over, all start again from the rule's choice  turn
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from pacesetter import algorithms
from pacesetter.algorithm import Algorithm, Spec
from pacesetter.config import Config
from pacesetter.envs import Environment
from pacesetter.errors import TrainingError
from pacesetter.evaluation import rollouts
from pacesetter.policy import Floats, Policy, clip, normalize, unstack
from pacesetter.rules import RULES
from pacesetter.seeding import Stream, generator
from pacesetter.training.normalizer import Normalizer, Statistics
from pacesetter.training.population import Population
from pacesetter.training.progress import Member, Progress
from pacesetter.training.replay import Columns, Replay
from pacesetter.training.selection import Selection, measure


class Ensemble:
    """Everything that a run trains and trains on; what of it must survive is in checkpoint.py."""

    def __init__(self, config: Config, envs: list[Environment]) -> None:
        run, hyper, first = config.run, config.hyper, envs[0]
        self.config, self.envs = config, envs
        spec = Spec(first.observation_size, first.action_size)
        self.algorithm: Algorithm = algorithms.find(run.algorithm).build(spec, hyper)
        self.columns = columns = Columns(*spec, len(self.algorithm.mask(generator(0, Stream.MASK))))
        self.population = Population(
            self.algorithm, columns, run.members, run.seed, hyper.normalize_observation
        )
        self.states = self.population.init(run.same_init)
        self.acting = self.population.acting(self.states)
        self.loss_names = self.population.loss_names(self.states)
        self.normalizer = Normalizer(spec.observation_size)
        self.budget = run.steps * config.unit
        self.replays: list[Replay] = []
        self.warmup_streams = [generator(run.seed, Stream.WARMUP, k) for k in range(run.members)]
        self.act_streams = [generator(run.seed, Stream.ACT, k) for k in range(run.members)]
        self.sample_streams = [generator(run.seed, Stream.SAMPLE, k) for k in range(run.members)]
        self.mask_streams = [generator(run.seed, Stream.MASK, k) for k in range(run.members)]
        self.rule_stream = generator(run.seed, Stream.RULE)
        spare = generator(run.seed, Stream.ACT)
        self.memory = [self.algorithm.begin(acting, spare) for acting in self.acting]
        self.progress = Progress.of(run.members)
        every = run.select_every * config.unit
        self.progress.next_selection = (hyper.warmup // every + 1) * every
        self.trial_env: Environment | None = None

    def open_replays(self, folder: Path) -> None:
        """Make or find the rings, whose files take their whole space at once."""
        count = 1 if self.config.run.replay_scope == "shared" else self.config.run.members
        size = self.config.hyper.replay_size
        for i in range(count):
            path = folder / f"replay-{i}.bin"
            self.replays.append(Replay(path, self.columns, size, self.budget))

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
        """Let go of envs and files."""
        for env in (*self.envs, self.trial_env):
            if env is not None:
                env.close()
        for replay in self.replays:
            replay.close()

    @property
    def statistics(self) -> Statistics:
        """What observations are normalised by, now."""
        return self.normalizer.statistics()

    def policy(self, member: int) -> Policy:
        """A member's policy as it is now."""
        state = jax.tree.map(lambda x: x[member], self.states)
        actors, env = self.algorithm.policy(state), self.envs[0]
        statistics = self.statistics if self.population.normalize else None
        layers = unstack(actors)
        return Policy(layers, actors.activation, actors.output, env.low, env.high, statistics)

    def replay(self, k: int) -> Replay:
        """The replay of a member: the shared one, or its own."""
        return self.replays[k % len(self.replays)]

    # Collect.

    def collect(self) -> None:
        """Every member in an episode acts and steps its own env, up to the budget."""
        progress, warmup = self.progress, self.config.hyper.warmup
        for k, member in progress.each():
            if member.starting:
                self._start(k, member)
        acting = [k for k, member in progress.each() if member.active]
        for k in acting[: self.budget - progress.step]:
            action = self._random(k) if progress.step < warmup else self._explore(k)
            with blame(k, progress.step):
                self._step(k, action)

    def _start(self, k: int, member: Member) -> None:
        with blame(k, self.progress.step):
            self.envs[k].reset()
        member.start(self.progress.step)
        self.memory[k] = self.algorithm.begin(self.acting[k], self.act_streams[k])

    def _random(self, k: int) -> Floats:
        size = self.envs[k].action_size
        return self.warmup_streams[k].uniform(-1, 1, size).astype(np.float32)

    def _explore(self, k: int) -> Floats:
        observation, rng = self.envs[k].observation, self.act_streams[k]
        if self.population.normalize:
            observation = normalize(observation, *self.statistics)
        acting, memory = self.acting[k], self.memory[k]
        action, self.memory[k] = self.algorithm.act(acting, memory, observation, rng)
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
        self.replay(k).add(
            before, action, step.reward, step.observation, discount, step.ended, mask
        )
        if self.population.normalize:
            self.normalizer.add(before)
        member.step(step.reward)
        if progress.step > hyper.warmup or hyper.warmup_updates:
            member.owed += hyper.updates_per_step
        if step.ended:
            progress.episodes += 1
            progress.ended.append([k, member.episode_return, member.episode_length])
            selects = self.config.run.members > 1 and self.config.run.select_on == "train"
            member.end(counts=selects and member.started >= hyper.warmup)

    # Learn.

    def learn(self) -> None:
        """Every member that owes a cycle of updates makes it, on its own minibatches."""
        cycle, at_end = self.algorithm.cycle, self.config.hyper.update_at == "episode"

        def ready(member: Member) -> bool:
            return member.owed >= cycle and not (at_end and member.active)

        while members := [k for k, member in self.progress.each() if ready(member)]:
            self._update(members)

    def _update(self, members: list[int]) -> None:
        progress, cycle = self.progress, self.algorithm.cycle
        shape = (cycle, self.config.hyper.batch_size)
        samples = [self.replay(k).sample(self.sample_streams[k], shape) for k in members]
        weights = [sample.weight for sample in samples if sample.weight is not None]
        result = self.population.update(
            self.states,
            members,
            np.stack([sample.rows for sample in samples]),
            np.stack(weights) if weights else None,
            self.statistics,
            [progress.members[k].cycles for k in members],
        )
        self.states = result.states
        self._check(members, result.losses)
        progress.note(result.losses)
        for place, k in enumerate(members):
            self.replay(k).feedback(samples[place].slots, result.error[place])
            self.acting[k] = result.acting[place]
            progress.members[k].owed -= cycle
            progress.members[k].cycles += 1
        progress.updates += cycle * len(members)
        progress.transitions += len(members) * shape[0] * shape[1]

    def _check(self, members: list[int], losses: Floats) -> None:
        if not np.isfinite(losses).all():
            place, column = np.argwhere(~np.isfinite(losses))[0]
            raise TrainingError(
                f"member {members[place]}, step {self.progress.step}: "
                f"{self.loss_names[column]} is {losses[place, column]}"
            )

    # Turn.

    def turn(self) -> Selection | None:
        """Select where a round or an interval is over; send on the members that waited."""
        run, progress = self.config.run, self.progress
        ended = [member for member in progress.members if not member.active]
        over = len(ended) == run.members if run.wait else bool(ended)
        selection = None
        if run.members > 1 and run.select_on == "eval":
            selection = self._select_on_trials()
        elif run.members > 1 and over:
            selection = self._select_on_training()
        if over:
            for member in ended:
                member.starting = True
        return selection

    def _select_on_training(self) -> Selection | None:
        window, members = self.config.run.select_window, self.progress.members
        if min(len(member.window) for member in members) < window:
            return None
        returns = np.array([member.window[-window:] for member in members])
        for member in members:
            member.window = []
        return self._select(returns)

    def _select_on_trials(self) -> Selection | None:
        """Extra noise-free episodes with the same starts for each member; their steps count."""
        run, progress = self.config.run, self.progress
        if progress.step <= self.config.hyper.warmup or progress.step < progress.next_selection:
            return None
        every = run.select_every * self.config.unit
        returns = [self._trial(k) for k in range(run.members)]
        progress.next_selection = (progress.step // every + 1) * every
        # A selection that the budget cut short decides nothing.
        return self._select(np.array(returns)) if progress.step < self.budget else None

    def _trial(self, k: int) -> list[float]:
        run, progress = self.config.run, self.progress
        if self.trial_env is None:
            self.trial_env = Environment(run.env, run.env_kwargs, run.seed, Stream.SELECT)
        first, left = progress.selections * run.select_window, self.budget - progress.step
        with blame(k, progress.step):
            act = self.policy(k).act
            trial = rollouts(act, self.trial_env, run.select_window, first, limit=left)
        progress.selection_steps += sum(trial.lengths)
        return trial.returns

    def _select(self, returns: Any) -> Selection:
        """Copy by the rule's choice from returns (K, episodes); the winner is the champion."""
        run, progress = self.config.run, self.progress
        means = returns.mean(axis=1)
        parents = RULES[run.rule](means, self.rule_stream)
        if run.rule != "none":
            self.states = self.population.inherit(self.states, parents, run.copy)
            self.acting = self.population.acting(self.states)
            progress.champion = champion(means, parents)
        progress.selections += 1
        gap, error = measure(returns, progress.variances)
        return Selection(parents.tolist(), progress.champion, returns.tolist(), gap, error)


def champion(means: Any, parents: Any) -> int:
    """The best member that went on from itself; if none did, the place of the best parent."""
    themselves = np.flatnonzero(parents == np.arange(len(parents)))
    if len(themselves):
        return int(themselves[np.argmax(means[themselves])])
    return int(np.argmax(means[parents]))


class blame:  # noqa: N801 (a context manager reads as a verb)
    """Name member and step in whatever an env does wrong."""

    def __init__(self, member: int, step: int) -> None:
        self.where = f"member {member}, step {step}"

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, TrainingError):
            raise TrainingError(f"{self.where}: {error}") from error

"""The members of a run: one tick of K learners that share a replay.

members that are in an episode act and step their envs                  collect
members that have updates due make them on their own minibatches        learn
when the round is over, all start again from what the rule chose        end_round
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pacesetter import algorithms
from pacesetter.batch import Spec
from pacesetter.config import Config
from pacesetter.ensemble.averages import Averages
from pacesetter.ensemble.copying import check_copy, copy_from_parents
from pacesetter.ensemble.experience import Experience
from pacesetter.ensemble.explorer import Explorer
from pacesetter.ensemble.loop import Part, numbered
from pacesetter.ensemble.policy_checkpoint import PolicyCheckpoints
from pacesetter.ensemble.progress import Progress
from pacesetter.ensemble.selection import Selection, Selector
from pacesetter.ensemble.updates import Updates
from pacesetter.ensemble.varied import spread
from pacesetter.envs import Environment
from pacesetter.errors import blame
from pacesetter.learner.compiled import of_transitions
from pacesetter.learner.learners import Learners
from pacesetter.policy import Policy
from pacesetter.replay.buffer import Replay

MAX_CALLS_PER_TICK = 500  # of updates per member, so that a run can stop and save between them


class Members:
    """K learners, what they learn from and where they act: the `Loop` of off-policy learning."""

    def __init__(self, config: Config, envs: list[Environment]) -> None:
        run, hyper, first = config.run, config.hyper, envs[0]
        spec = Spec(first.observation_size, first.action_size)
        compiled = of_transitions(algorithms.find(run.algorithm).build(spec, hyper), run.seed)
        self.config = config
        self.budget = config.budget
        self.learners = Learners(compiled, run.members, run.seed, run.same_init)
        check_copy(compiled.learner, self.learners.states, run.copy)
        # Env n of member k has the number n K + k.
        self.explorers = [
            Explorer(
                compiled.learner, env, self.learners.policy_params[i % run.members], run.seed, i
            )
            for i, env in enumerate(envs)
        ]
        self.experience = Experience(config, spec, compiled.layout, len(envs))
        self.selector = Selector(config, self.budget, first.recipe)
        self.policy_checkpoints = PolicyCheckpoints(hyper, run.members, self.current_policy(0))
        self.averages = Averages(run, self.learners, self.current_policy(0))
        self.progress = Progress.of(run.members, spread(run, hyper, run.seed))
        self.updates = Updates(config, self.learners, self.experience, self.progress, self.averages)
        self.whole = True

    @property
    def replays(self) -> list[Replay]:
        return self.experience.replays

    def open_replays(self, folder: Path) -> None:
        """Make or find the replays' files."""
        self.experience.open_replays(folder)

    def tick(self) -> Selection | None:
        """One tick; the selection, if it made one."""
        self.collect()
        self.whole = False
        self.learn()
        selection = self.end_round()
        self.progress.tick += 1
        self.whole = True
        return selection

    def close(self) -> None:
        """Let go of envs, files and threads."""
        with ExitStack() as stack:
            for each in (self.experience, self.selector, *(e.env for e in self.explorers)):
                stack.callback(each.close)
            self.learners.workers.shutdown()

    def training_values(self) -> dict[str, Any]:
        """How training went since this was last called."""
        return self.progress.training_values() | self.policy_checkpoints.training_values()

    def policy(self, member: int) -> Policy:
        """A member's policy: the best that was kept, if any was, or as it is now."""
        return self.policy_checkpoints.policy(member) or self.current_policy(member)

    def averaged(self, champion: Policy) -> dict[str, list[Policy]]:
        """Policies whose mean action is evaluated beside the champion's."""
        members = range(self.config.run.members)
        now = [self.current_policy(k) for k in members]
        return self.averages.policies(champion, [self.policy(k) for k in members], now)

    def keep_snapshot(self, champion: Policy) -> None:
        """Let the champion of an evaluation that is made join the snapshots."""
        self.averages.keep_snapshot(champion)

    def current_policy(self, member: int) -> Policy:
        """A member's policy as it is now."""
        normalizer = self.experience.normalizer
        return self.explorers[member].policy(self.learners.states[member], normalizer)

    # Collect: i is the number of an env, k that of its member.

    def collect(self) -> None:
        """Every env acts whose episode runs and whose member has no updates due.

        Where a task's fault broke it off, it goes on with the action that was not made.
        """
        progress, members = self.progress, self.config.run.members
        if not progress.acting:
            self._begin_collecting()
        while progress.acting:
            i = progress.acting[0]
            if self.explorers[i].starting:  # a resumed run could not restore its episode
                self._start_episode(i)
            with blame(i % members, progress.step):
                self._step(i)
            del progress.acting[0]

    def _begin_collecting(self) -> None:
        progress, members = self.progress, self.config.run.members
        for i, explorer in enumerate(self.explorers):
            if explorer.starting:
                self._start_episode(i)
        due = [self._updates_due(k) for k in range(members)]
        for member, has_due in zip(progress.members, due, strict=True):
            member.ended = member.ended and has_due
        acting = [i for i, e in enumerate(self.explorers) if e.active and not due[i % members]]
        progress.acting = acting[: self.budget - progress.step]

    def _start_episode(self, i: int) -> None:
        k = i % self.config.run.members
        self.experience.start_episode(i)
        with blame(k, self.progress.step):
            self.explorers[i].start(self.learners.policy_params[k], self.progress.step)
        self.policy_checkpoints.start_episode(k)

    def _step(self, i: int) -> None:
        hyper, progress, explorer = self.config.hyper, self.progress, self.explorers[i]
        k = i % self.config.run.members
        member, warming_up = progress.members[k], progress.step < hyper.warmup
        if explorer.pending is not None:
            action = explorer.pending
        elif warming_up:
            action = explorer.random_action()
        else:
            seen = self.experience.normalizer.scale(explorer.env.observation)
            action = explorer.act(self.learners.policy_params[k], seen, member.scales)
            member.actions += 1
        transition = explorer.step(action, hyper.gamma, clipped=True)
        self.experience.add(i, transition)
        member.steps += 1
        if hyper.warmup_updates or not warming_up:
            member.updates_due += hyper.updates_per_step
        if transition.last:
            self._end_episode(i, k)

    def _end_episode(self, i: int, k: int) -> None:
        progress, explorer = self.progress, self.explorers[i]
        member, total = progress.members[k], explorer.env.earned
        member.ended = True
        progress.end_episode(k, total, len(explorer.env.actions))
        self.experience.end_episode(i, total)
        self.selector.end_episode(k, total, explorer.started, member.copied)
        if self.config.hyper.assess and explorer.started >= self.config.hyper.warmup:
            if explorer.started < member.copied:
                self.policy_checkpoints.skip_episode(k)
                return
            updates = member.update_calls * self.updates.per_call
            policy = self.current_policy(k)
            self.policy_checkpoints.end_episode(k, total, updates, policy, progress.step)

    # Learn.

    @property
    def has_due_updates(self) -> bool:
        """Whether updates are due that did not fit into the last tick."""
        return any(self._updates_due(k) for k in range(self.config.run.members))

    def learn(self) -> None:
        """Every member makes the updates that are due, on its own minibatches."""
        for _ in range(MAX_CALLS_PER_TICK):
            members = [k for k in range(self.config.run.members) if self._updates_due(k)]
            if not members:
                break
            self.updates.make(members)

    def _updates_due(self, k: int) -> bool:
        hyper, member = self.config.hyper, self.progress.members[k]
        later = member.steps % hyper.block * hyper.updates_per_step  # of a block that is not full
        if member.updates_due - later < self.updates.per_call or not len(self.experience.replay(k)):
            return False
        if hyper.update_at == "episode" and not member.ended:
            return False
        return self.policy_checkpoints.may_update(k)

    # End a round.

    def end_round(self) -> Selection | None:
        """Select where a round or an interval is over; send on the members that waited."""
        run, progress = self.config.run, self.progress
        ended = [i for i, explorer in enumerate(self.explorers) if not explorer.active]
        waits = run.wait and run.members > 1
        over = len(ended) == len(self.explorers) if waits else bool(ended)
        if over and any(self._updates_due(i % run.members) for i in ended):
            return None  # so many updates that they take several ticks
        selection = None
        if self.selector.trials_are_due(progress.step):
            policies = [self.current_policy(k) for k in range(run.members)]
            selection = self.selector.on_trials(policies, progress)
        elif over:
            selection = self.selector.on_training(progress)
        if selection is not None:
            self.apply(selection)
        if over:
            for i in ended:
                self.explorers[i].starting = True
        return selection

    def apply(self, selection: Selection) -> None:
        """Every member starts again from what was chosen for it."""
        parents, weights, *_ = selection.choice
        learner, copy = self.learners.compiled.learner, self.config.run.copy
        states = copy_from_parents(learner, self.learners.states, parents, copy, weights)
        self.learners.replace(states)
        self.policy_checkpoints.copy(parents, averaged=weights is not None)
        self.averages.copy(selection.choice)
        self.progress.copy(selection.choice)
        self.progress.champion = selection.champion

    def parts(self) -> dict[str, Part]:
        """What a checkpoint holds; envs come last, because they step when they are restored."""
        return {
            "states": self.learners,
            "progress": self.progress,
            "selector": self.selector,
            "kept": self.policy_checkpoints,
            "averages": self.averages,
            **self.experience.parts(),
            **numbered("env", self.explorers),
        }

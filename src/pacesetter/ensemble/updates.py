"""The updates of the members, each on minibatches of its own."""

from collections.abc import Sequence

import numpy as np

from pacesetter.config import Config
from pacesetter.ensemble.averages import Averages
from pacesetter.ensemble.experience import Experience
from pacesetter.ensemble.progress import Progress
from pacesetter.learner.compiled import UpdateInputs
from pacesetter.learner.learners import Learners
from pacesetter.learner.schedule import factors
from pacesetter.replay.buffer import Sample

CHECK_EVERY = 100  # calls of a member's update, between two looks at its whole state, each 0.3 ms


class Updates:
    """Samples minibatches, updates the learners on them and tells the replay the TD errors."""

    def __init__(
        self,
        config: Config,
        learners: Learners,
        experience: Experience,
        progress: Progress,
        averages: Averages,
    ) -> None:
        self.config, self.learners, self.experience = config, learners, experience
        self.progress, self.averages = progress, averages
        self.lr_updates = config.lr_updates
        self.per_call = learners.compiled.learner.updates_per_call

    def make(self, members: Sequence[int]) -> None:
        """One call of the update of each of these members, all at the same time."""
        samples = [self._sample(k) for k in members]
        statistics, scale = self.experience.normalizer.statistics(), self.experience.return_scale
        extra = {"return_deviation": scale.deviation} if scale else None
        inputs: list[UpdateInputs] = []
        for k, sample in zip(members, samples, strict=True):
            member, data = self.progress.members[k], (sample.rows, sample.weight, statistics)
            made = member.update_calls * self.per_call
            scales = factors(self.config.hyper, member.scales, made, self.lr_updates)
            inputs.append(UpdateInputs(member.update_calls, *data, extra, scales))
        results = self.learners.update(members, inputs)
        for k, sample, result in zip(members, samples, results, strict=True):
            self.progress.add_losses(self.learners.loss_names, result.losses, k)
            self.experience.replay(k).feedback(sample.numbers, np.asarray(result.td_error))
            self.progress.members[k].update_calls += 1
            if self.progress.members[k].update_calls % CHECK_EVERY == 0:
                self.learners.refuse_faults([k], self.progress.step)
            self.averages.follow(k)

    def _sample(self, k: int) -> Sample:
        batch_size, progress = self.config.hyper.batch_size, self.progress
        progress.begin_updates(k, self.per_call, batch_size)
        done = self.config.annealed(progress.step)
        shape = (self.per_call, batch_size)
        return self.experience.replay(k).sample(self.learners.sample_streams[k], shape, done)

"""What the members learn from: their replays, and the statistics of what came into them."""

from pathlib import Path

from pacesetter.batch import Layout, Spec, Transition
from pacesetter.config import Config
from pacesetter.ensemble.loop import Part, numbered
from pacesetter.learner.normalizer import Normalizer, ReturnScale
from pacesetter.replay.buffer import Replay, open_replays
from pacesetter.replay.n_step import NStepQueue


class Experience:
    """Takes the transitions of all envs and gives minibatches to all members.

    Env n of member k has the number i = n K + k. Members share one replay or have one each.
    """

    def __init__(self, config: Config, spec: Spec, layout: Layout, envs: int) -> None:
        run, hyper = config.run, config.hyper
        self.config, self.layout, self.members = config, layout, run.members
        self.normalizer = Normalizer(spec.observation_size, hyper.normalize_observation)
        self.return_scale = ReturnScale(hyper.gamma, envs) if hyper.scales_rewards else None
        self.queues = [NStepQueue(hyper.n_step) for _ in range(envs)]
        self.replays: list[Replay] = []

    def open_replays(self, folder: Path) -> None:
        """Make or find the replays' files."""
        config = self.config
        count = 1 if config.run.replay_scope == "shared" else self.members
        self.replays = open_replays(folder, count, self.layout, config.hyper, config.budget)

    def replay(self, k: int) -> Replay:
        """The replay of member k: the shared one, or its own."""
        return self.replays[k % len(self.replays)]

    def start_episode(self, i: int) -> None:
        """Env i starts anew; what is left of an episode that was abandoned becomes rows."""
        replay = self.replay(i % self.members)
        for transition in self.queues[i].flush():
            replay.add(transition, i)
        replay.sampler.end(i, None)
        if self.return_scale:
            self.return_scale.running[i] = 0.0

    def add(self, i: int, transition: Transition) -> None:
        """Env i made a step."""
        replay = self.replay(i % self.members)
        for complete in self.queues[i].push(transition):
            replay.add(complete, i)
        self.normalizer.add(transition.observation)
        if self.return_scale:
            self.return_scale.add(i, transition.reward, transition.last)

    def end_episode(self, i: int, total: float) -> None:
        """Env i ended an episode with this return."""
        self.replay(i % self.members).sampler.end(i, total)

    def close(self) -> None:
        """Let go of the replays' files."""
        for replay in self.replays:
            replay.close()

    def parts(self) -> dict[str, Part]:
        """What a checkpoint holds of it."""
        return {
            "normalizer": self.normalizer,
            **({"returns": self.return_scale} if self.return_scale else {}),
            **numbered("queue", self.queues),
            **numbered("replay", self.replays),
        }

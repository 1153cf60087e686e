"""Who sets the pace: selections on training episodes or on extra trials, and how sure each was."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

import numpy as np

from pacesetter.config import Config
from pacesetter.ensemble.progress import Progress
from pacesetter.ensemble.rules import Choice, Parents, Returns, choose
from pacesetter.ensemble.varied import decided, inherited, shown
from pacesetter.envs import Environment, Recipe
from pacesetter.errors import blame
from pacesetter.evaluation import rollouts
from pacesetter.policy import Policy
from pacesetter.seeding import Stream, generator
from pacesetter.settings.validation import Finite, Natural, check
from pacesetter.types import Arrays

POOLED_SELECTIONS = 20


class Selection(NamedTuple):
    """Who starts again from whom, and on what grounds."""

    choice: Choice
    champion: int
    returns: list[list[float]]  # (K, episodes)
    gap: float
    standard_error: float
    settings: dict[str, list[float]]  # of each member (K,) from now on, where they vary

    def row(self) -> dict[str, Any]:
        """As plain JSON for the log."""
        parents, weights, scales, _ = self.choice
        row = {"parents": parents.tolist(), **self._asdict()}
        del row["choice"]
        if not self.settings:
            del row["settings"]
        if weights is not None:
            row["weights"] = weights.tolist()
        if scales is not None:
            row["scales"] = {name: factors.tolist() for name, factors in scales.items()}
        return row


@dataclass
class _Saved:
    """The selector in a checkpoint."""

    stream: dict[str, Any]
    returns: list[list[Finite]]
    variances: list[Finite]
    selections: Natural
    next_trials: Natural


class Selector:
    """Selects by the rule of the settings; the members apply what it returns."""

    def __init__(self, config: Config, budget: int, recipe: Recipe) -> None:
        self.config, self.budget, self.recipe = config, budget, recipe
        self.stream = generator(config.run.seed, Stream.RULE)
        self.returns: list[list[float]] = [[] for _ in range(config.run.members)]
        self.variances: list[float] = []  # of the last selections
        self.selections = 0
        self.next_trials = 0
        self.trial_env: Environment | None = None
        self._plan_trials(config.select_after)

    def end_episode(self, k: int, total: float, started: int, copied: int) -> None:
        """Add a training episode of member k; it counts if it began after the warm-up, at step
        `started`, and the weights that played it are still the member's own.
        """
        run = self.config.run
        counts = run.members > 1 and run.select_on == "train"
        if counts and started >= max(self.config.select_after, copied):
            self.returns[k].append(total)

    def on_training(self, progress: Progress) -> Selection | None:
        """Select on the training episodes since the last selection, once each member has enough.

        A round with several envs per member counts whole: its last episodes are its longest.
        """
        run, fewest = self.config.run, min(len(returns) for returns in self.returns)
        if fewest < run.window:
            return None
        counted = fewest if run.wait else run.window
        returns = np.array([each[-counted:] for each in self.returns])
        self.returns = [[] for _ in self.returns]
        return self._select(returns, progress, paired=False)

    def trials_are_due(self, step: int) -> bool:
        """Whether extra episodes must decide now."""
        run = self.config.run
        by_trials = run.members > 1 and run.select_on == "eval"
        return by_trials and self.next_trials <= step < self.budget

    def on_trials(self, policies: Sequence[Policy], progress: Progress) -> Selection | None:
        """Select on extra noise-free episodes with the same starts for each; the progress counts
        their steps. A selection that the budget cuts short decides nothing.
        """
        returns = [self._trial(k, policy, progress) for k, policy in enumerate(policies)]
        self._plan_trials(progress.step)
        if progress.step >= self.budget:
            return None
        return self._select(np.array(returns), progress, paired=True)

    def _plan_trials(self, step: int) -> None:
        every = self.config.run.select_every * self.config.steps_per_count
        self.next_trials = (step // every + 1) * every

    def _trial(self, k: int, policy: Policy, progress: Progress) -> list[float]:
        run = self.config.run
        if self.trial_env is None:
            self.trial_env = Environment(self.recipe, run.seed, Stream.SELECT)
        first, counted = self.selections * run.window, run.count_selection_steps
        limit = self.budget - progress.step if counted else inf
        with blame(k, progress.step):
            trial = rollouts(policy.act, self.trial_env, run.window, first, limit=limit)
        progress.selection_steps += sum(trial.lengths)
        progress.free_steps += 0 if counted else sum(trial.lengths)
        return trial.returns

    def _select(self, returns: Returns, progress: Progress, paired: bool) -> Selection:
        means, rule = returns.mean(axis=1), self.config.run.rule
        hyper, scales = self.config.hyper, [member.scales for member in progress.members]
        choice = choose(rule, returns, self.stream)
        choice = decided(choice, self.config.run, hyper, scales, self.stream)
        champion = progress.champion
        if rule != "none":
            champion = find_champion(means, choice.parents)
        self.selections += 1
        gap, error = measure(returns, self.variances, paired)
        settings = shown(self.config.run, hyper, inherited(choice, scales))
        return Selection(choice, champion, returns.tolist(), gap, error, settings)

    def table(self) -> dict[str, Any]:
        return {
            "stream": self.stream.bit_generator.state,
            "returns": self.returns,
            "variances": self.variances,
            "selections": self.selections,
            "next_trials": self.next_trials,
        }

    def arrays(self) -> Arrays:
        return {}

    def restore(self, table: dict[str, Any], arrays: Arrays) -> None:
        """The inverse of `table`."""
        check(_Saved, table)
        if len(table["returns"]) != len(self.returns):
            raise ValueError(f"returns of {len(table['returns'])} members")
        self.stream.bit_generator.state = table["stream"]
        self.returns, self.variances = table["returns"], table["variances"]
        self.selections, self.next_trials = table["selections"], table["next_trials"]

    def close(self) -> None:
        """Let go of the env of trials."""
        if self.trial_env is not None:
            self.trial_env.close()


def measure(returns: Returns, variances: list[float], paired: bool) -> tuple[float, float]:
    """Best mean return minus the next, and the standard error of such a difference.

    With n > 1 episodes per member, the variance is that of a member's own episodes; `paired` ones
    had the same starts for each member, and what a start does to all is subtracted. With one, it
    is that between the members: after a copy they are clones, so their spread is noise, and where
    they are not, the error is overstated. Either is pooled over the last 20 selections, which
    `variances` remembers.
    """
    members, episodes = returns.shape
    means = np.sort(returns.mean(axis=1))
    if episodes == 1:
        spread = returns.var(ddof=1)
    else:
        own = returns - returns.mean(axis=1, keepdims=True)
        own = own - own.mean(axis=0) if paired else own
        spread = (own**2).sum() / ((members - paired) * (episodes - 1))
    variances.append(float(spread))
    del variances[:-POOLED_SELECTIONS]
    error = float(np.sqrt(2 * np.mean(variances) / episodes))
    return float(means[-1] - means[-2]), error


def find_champion(means: Returns, parents: Parents) -> int:
    """The best member that went on from itself; if none did, the place of the best parent."""
    themselves = np.flatnonzero(parents == np.arange(len(parents)))
    if len(themselves):
        return int(themselves[np.argmax(means[themselves])])
    return int(np.argmax(means[parents]))

"""Who sets the pace: selections on training episodes or on extra trials, and how sure each was."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pacesetter.ensemble.rules import RULES, Parents
from pacesetter.envs import Environment
from pacesetter.errors import blame
from pacesetter.evaluation import rollouts
from pacesetter.seeding import Stream

if TYPE_CHECKING:
    from pacesetter.ensemble.members import Ensemble

Returns = NDArray[np.float64]
REMEMBERED = 20


class Selection(NamedTuple):
    """Who starts again from whom, and on what grounds; returns are (K, episodes)."""

    parents: list[int]
    champion: int
    returns: list[list[float]]
    gap: float
    standard_error: float


def measure(returns: Returns, variances: list[float], paired: bool) -> tuple[float, float]:
    """Best mean return minus the next, and the standard error of such a difference.

    With n > 1 episodes a member, the variance is that of a member's own episodes; `paired` ones had
    the same starts for each member, and what a start does to all is taken out. With one, it is
    that between the members: after a copy they are clones, so their spread is noise, and where
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
    del variances[:-REMEMBERED]
    error = float(np.sqrt(2 * np.mean(variances) / episodes))
    return float(means[-1] - means[-2]), error


def on_training(ensemble: Ensemble) -> Selection | None:
    """Select on the training episodes since the last selection, once each member has enough."""
    window, members = ensemble.config.run.select_window, ensemble.progress.members
    if min(len(member.window) for member in members) < window:
        return None
    returns = np.array([member.window[-window:] for member in members])
    for member in members:
        member.window = []
    return _select(ensemble, returns, paired=False)


def on_trials(ensemble: Ensemble) -> Selection | None:
    """Select on extra noise-free episodes with the same starts for each."""
    config, progress = ensemble.config, ensemble.progress
    if progress.step < progress.next_selection or progress.step >= ensemble.budget:
        return None
    every = config.run.select_every * config.steps_per_count
    returns = [_trial(ensemble, k) for k in range(config.run.members)]
    progress.next_selection = (progress.step // every + 1) * every
    # A selection that the budget cut short decides nothing.
    if progress.step >= ensemble.budget:
        return None
    return _select(ensemble, np.array(returns), paired=True)


def _trial(ensemble: Ensemble, k: int) -> list[float]:
    """Returns of noise-free episodes of a member, from the starts of this selection."""
    run, progress = ensemble.config.run, ensemble.progress
    if ensemble.trial_env is None:
        ensemble.trial_env = Environment(run.env, run.env_kwargs, run.seed, Stream.SELECT)
    env, first = ensemble.trial_env, progress.selections * run.select_window
    counted = run.count_selection_steps
    limit = ensemble.budget - progress.step if counted else inf
    with blame(k, progress.step):
        trial = rollouts(ensemble.current(k).act, env, run.select_window, first, limit=limit)
    progress.selection_steps += sum(trial.lengths)
    progress.free_steps += 0 if counted else sum(trial.lengths)
    return trial.returns


def _select(ensemble: Ensemble, returns: Returns, paired: bool) -> Selection:
    """Copy by the rule's choice from returns (K, episodes); the winner is the champion."""
    run, progress = ensemble.config.run, ensemble.progress
    means = returns.mean(axis=1)
    parents = RULES[run.rule](means, ensemble.rule_stream)
    if run.rule != "none":
        ensemble.descend(parents)
        progress.champion = champion(means, parents)
    progress.selections += 1
    gap, error = measure(returns, progress.variances, paired)
    return Selection(parents.tolist(), progress.champion, returns.tolist(), gap, error)


def champion(means: Returns, parents: Parents) -> int:
    """The best member that went on from itself; if none did, the place of the best parent."""
    themselves = np.flatnonzero(parents == np.arange(len(parents)))
    if len(themselves):
        return int(themselves[np.argmax(means[themselves])])
    return int(np.argmax(means[parents]))

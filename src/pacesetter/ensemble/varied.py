"""Members that differ: how settings are spread over them (`--vary`), inherited and perturbed."""

from collections.abc import Sequence
from dataclasses import asdict, fields
from itertools import product
from math import prod
from typing import Any

import numpy as np

from pacesetter.ensemble.rules import Choice
from pacesetter.errors import UsageError
from pacesetter.learner.scales import scale_of, value_of
from pacesetter.learner.schedule import learning_rates
from pacesetter.seeding import Stream, generator
from pacesetter.settings.ensemble import VARIABLE, Ensemble
from pacesetter.settings.validation import build

Scales = dict[str, float]  # factors of one member's settings
PERTURBED = (0.8, 1.2)  # (Jaderberg et al. 2017)
DIGITS = 6  # of a setting in the log


def check(run: Ensemble, hyper: Any) -> None:
    """Refuse what cannot vary, or not so. Raises UsageError."""
    if run.rule == "pbt" and not run.vary:
        raise UsageError("rule: pbt perturbs settings, but none vary; give --vary or another rule")
    if not run.vary:
        return
    if run.members == 1:
        raise UsageError("vary: needs several members, got 1; give --members")
    allowed = [name for name in VARIABLE if name in {field.name for field in fields(hyper)}]
    for name, values in run.vary.items():
        if name not in allowed:
            raise UsageError(f"vary: '{name}' cannot differ; allowed: {', '.join(allowed)}")
        if len(set(values)) < 2:
            raise UsageError(f"vary: {name} needs at least two different values, got {values}")
        for value in values:
            try:
                build(type(hyper), asdict(hyper) | {name: value})
            except UsageError as error:
                raise UsageError(f"vary: {error}") from None
    _check_bases(run, hyper)
    size = prod(len(values) for values in run.vary.values())
    if run.vary_by == "grid" and run.members % size:
        raise UsageError(
            f"members: the grid of --vary has {size} points, got {run.members} members; "
            f"give {size}, a multiple, or --vary-by draw"
        )


def _check_bases(run: Ensemble, hyper: Any) -> None:
    """Refuse settings whose own value has no factors, and gamma where rows hold sums of rewards."""
    if "exploration_noise" in run.vary and hyper.exploration_noise == 0:
        raise UsageError("vary: exploration_noise itself is 0; must be above 0 to vary")
    if "exploration_noise" in run.vary and getattr(hyper, "exploration", None) == "parameter":
        raise UsageError(
            "vary: exploration_noise cannot differ with --exploration parameter, which adapts and "
            "copies the noise with the networks"
        )
    if "gamma" in run.vary and not 0 < hyper.gamma < 1:
        raise UsageError(f"vary: gamma itself is {hyper.gamma}; must lie between 0 and 1 to vary")
    if "gamma" in run.vary and getattr(hyper, "bins", 0):
        raise UsageError(
            "vary: gamma cannot differ with --bins, whose range fits the returns of one gamma"
        )
    if "gamma" in run.vary and hyper.n_step > 1:
        raise UsageError(
            f"vary: gamma cannot differ with n_step={hyper.n_step}, as members share discounted "
            "sums of rewards; use --n-step 1"
        )


def spread(run: Ensemble, hyper: Any, seed: int) -> list[Scales]:
    """The factors that each member begins with.

    `grid` gives the members the points of the grid in turn, the last name fastest. `draw` gives
    each name's values to the members in a random order of its own, each value as often.
    """
    numbers = np.arange(run.members)
    if run.vary_by == "grid":
        points = list(product(*run.vary.values()))
        drawn = [points[k % len(points)] for k in numbers]
    else:
        columns = [
            generator(seed, Stream.VARY, i).permutation(np.resize(values, run.members)).tolist()
            for i, values in enumerate(run.vary.values())
        ]
        drawn = list(zip(*columns, strict=True)) if columns else [()] * run.members
    return [
        {
            name: scale_of(name, getattr(hyper, name), value)
            for name, value in zip(run.vary, point, strict=True)
        }
        for point in drawn
    ]


def decided(
    choice: Choice, run: Ensemble, hyper: Any, before: Sequence[Scales], rng: np.random.Generator
) -> Choice:
    """A rule's choice with the perturbations it asks for drawn: each setting of such a member is
    0.8 or 1.2 times its parent's, within the range of --vary. Of gamma, that is 1 - gamma.
    """
    rates = learning_rates(hyper)
    for name in choice.scales or {}:
        if name not in {*rates, *run.vary}:
            allowed = ", ".join(rates)
            raise UsageError(f"rule: cannot scale '{name}' of members; allowed: {allowed}")
    if choice.perturb is None:
        return choice
    scales = dict(choice.scales or {})
    for name, values in run.vary.items():
        limits = [scale_of(name, getattr(hyper, name), value) for value in values]
        parents = np.array([before[parent][name] for parent in choice.parents])
        drawn = parents * rng.choice(PERTURBED, size=len(parents))
        moved = np.where(choice.perturb, np.clip(drawn, min(limits), max(limits)), parents)
        ones = np.ones_like(parents)
        scales[name] = np.divide(moved, parents, out=ones, where=parents != 0)
    return choice._replace(scales=scales)


def inherited(choice: Choice, before: Sequence[Scales]) -> list[Scales]:
    """Everyone's factors after a selection: their own, or, if the rule scales some, their
    parent's, multiplied by those."""
    if choice.scales is None:
        return list(before)
    return [
        before[parent]
        | {name: before[parent].get(name, 1.0) * float(x[k]) for name, x in choice.scales.items()}
        for k, parent in enumerate(choice.parents)
    ]


def shown(run: Ensemble, hyper: Any, scales: Sequence[Scales]) -> dict[str, list[float]]:
    """The value of each varied setting for each member (K,), as the log has it."""
    return {
        name: [
            float(f"{value_of(name, getattr(hyper, name), each[name]):.{DIGITS}g}")
            for each in scales
        ]
        for name in run.vary
    }

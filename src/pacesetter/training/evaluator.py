"""Evaluations of a run on starts that training never uses, and the policy files they write."""

from pathlib import Path
from typing import Any

from pacesetter.config import Config
from pacesetter.ensemble.averages import mean_action, mean_policy
from pacesetter.ensemble.loop import Loop
from pacesetter.ensemble.varied import shown
from pacesetter.envs import Environment, Recipe
from pacesetter.errors import blame
from pacesetter.evaluation import Act, Evaluation, rollouts
from pacesetter.files import make_folder
from pacesetter.policy import Policy
from pacesetter.runs import RunDirectory
from pacesetter.runs.provenance import versions
from pacesetter.seeding import Stream
from pacesetter.types import Floats


class Stopped(Exception):  # noqa: N818 (it is no error)
    """An evaluation was given up; a resumed run makes it."""


class Evaluator:
    """Rolls out what `--eval-policy` names, and beside it members and mean actions."""

    def __init__(self, loop: Loop, config: Config, directory: RunDirectory, recipe: Recipe) -> None:
        self.loop, self.config, self.directory, self.recipe = loop, config, directory, recipe
        self._env: Environment | None = None
        self._stopping = False

    def policy(self, member: int | None = None) -> Policy:
        """A member's policy, or what `--eval-policy` names, and where it comes from.

        With `--assess` a member's is the best that was kept (`about["kept_at"]`), else what it is
        now.
        """
        progress, run = self.loop.progress, self.config.run
        policy = self.loop.policy(progress.champion if member is None else member)
        if member is None and run.eval_policy == "ema":
            policy = mean_policy(self.loop.averaged(policy)["ema"])
            policy.about.update(eval_policy=run.eval_policy)
        names = ("env", "env_kwargs", "algorithm", "name", "seed")
        policy.about.update({name: getattr(run, name) for name in names})
        policy.about.update(wrap=[*self.recipe.wrap], renew_env=self.recipe.renew)
        policy.about.update(step=progress.step, versions=versions())
        if seen := getattr(self.config.hyper, "actor_observes", None):
            policy.about["actor_observes"] = seen
        return policy

    def evaluate(self, ending: bool) -> dict[str, Any]:
        """Evaluate the policy and write its files; the values of a row of the log.

        Nothing changes before all is played. Raises Stopped after `stop`.
        """
        run, progress = self.config.run, self.loop.progress
        self.loop.learners.refuse_faults(range(run.members), progress.step)
        policy, champion = self.policy(), self.policy(progress.champion)
        trial = self._trial(policy.act, progress.champion)
        values = trial.table() | {"champion": progress.champion}
        if means := self._mean_actions(champion):
            values["mean_actions"] = means
        if run.vary:
            scales = [member.scales for member in progress.members]
            values["settings"] = shown(run, self.config.hyper, scales)
        if run.members > 1 and (run.mean_actions == "on" or (ending and run.rule == "none")):
            beside = means.get("champion", {}).get("mean")
            known = trial.mean if run.eval_policy == "champion" else beside
            values["members"] = self._each_member(known)
        self._save(policy, trial)
        self.loop.keep_snapshot(champion)
        return values

    def stop(self) -> None:
        """Give up the evaluation that is being made, and make no other."""
        self._stopping = True

    def close(self) -> None:
        """Let go of the env."""
        if self._env is not None:
            self._env.close()

    def _save(self, policy: Policy, trial: Evaluation) -> None:
        progress, episodes = self.loop.progress, self.config.run.eval_episodes
        score = {"score": trial.mean, "score_std": trial.std, "score_episodes": episodes}
        policy.about.update(score)
        policy.save(self.directory.policy_file)
        if keep := self.config.run.keep:
            _keep(policy, self.directory.policies, progress.step, keep)
        if progress.step == 0:
            return
        standing = progress.standing.after(trial.mean, progress.updates)
        better = standing.best != progress.best
        progress.best, progress.since_best = standing
        if better:
            policy.about["score_note"] = "the best of many evaluations, so biased upwards"
            policy.save(self.directory.best_file)

    def _mean_actions(self, champion: Policy) -> dict[str, Any]:
        """Mean, deviation and returns of each policy beside the evaluated one, on its starts."""
        run, found = self.config.run, dict[str, Any]()
        beside = self.loop.averaged(champion)
        if run.eval_policy == "ema":
            del beside["ema"]
            beside |= {"champion": [champion]} if run.evaluates_means else {}
        for name, policies in beside.items():
            trial = self._trial(mean_action(policies), self.loop.progress.champion)
            found[name] = {"mean": trial.mean, "std": trial.std, "returns": trial.returns}
        return found

    def _each_member(self, known: float | None) -> list[float]:
        """Mean return of every member on the same starts; the champion's may be known."""
        champion = self.loop.progress.champion
        return [
            known
            if known is not None and k == champion
            else self._trial(self.policy(k).act, k).mean
            for k in range(self.config.run.members)
        ]

    def _trial(self, act: Act, member: int) -> Evaluation:
        run = self.config.run
        if self._env is None:
            self._env = Environment(self.recipe, run.seed, Stream.EVALUATE)
        with blame(member, self.loop.progress.step):
            return rollouts(
                lambda observation: self._act(act, observation), self._env, run.eval_episodes
            )

    def _act(self, act: Act, observation: Floats) -> Floats:
        if self._stopping:
            raise Stopped
        return act(observation)


def _keep(policy: Policy, folder: Path, step: int, most: int) -> None:
    """Write the policy of a step, and remove the oldest beyond so many.

    Those of later steps too: of evaluations that a killed run made after its last checkpoint.
    """
    make_folder(folder)
    policy.save(folder / f"step-{step}.safetensors")
    found = [file for file in folder.glob("step-*.safetensors") if file.stem[5:].isdecimal()]
    kept = {int(file.stem[5:]): file for file in found}
    later = [number for number in kept if number > step]
    for number in (*later, *sorted(kept.keys() - {*later})[:-most]):
        kept[number].unlink()

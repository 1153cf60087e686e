"""The training loop: an iterator of reports that can stop and go on at any tick.

members that are in an episode act and step their envs          _collect
members that owe enough updates make them on their own batches  _learn
when the round is over, all start again from the rule's choice  _turn
what is due is evaluated and logged; now and then all is saved  _report, _save
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np

from pacesetter import algorithms
from pacesetter.algorithm import Algorithm, Spec
from pacesetter.config import read_file, settle
from pacesetter.envs import Environment
from pacesetter.errors import TrainingError, UsageError
from pacesetter.evaluate import Evaluation, rollouts
from pacesetter.policy import Floats, Policy, unstack
from pacesetter.rules import RULES
from pacesetter.runs import RunDirectory, find, provenance
from pacesetter.seeding import Stream, generator
from pacesetter.training import checkpoint
from pacesetter.training.normalizer import Normalizer
from pacesetter.training.population import Population
from pacesetter.training.progress import TRAIN_ROW_EVERY, Clock, Member, Progress
from pacesetter.training.replay import Columns, Replay
from pacesetter.training.selection import measure


@dataclass(frozen=True)
class Report:
    """One row of the log: an evaluation, a selection, or how training went since the last row."""

    kind: str
    step: int
    values: dict[str, Any]
    ledger: dict[str, Any]

    def row(self) -> dict[str, Any]:
        """As the line of metrics.jsonl."""
        return {"kind": self.kind, "step": self.step, **self.values, **self.ledger}


class Trainer:
    """A run, new or resumed: iterate over it to train, break to stop; it goes on with `resume`."""

    def __init__(
        self,
        algorithm: str,
        env: str,
        *,
        runs: str | Path = "runs",
        config: str | Path | None = None,
        **settings: Any,
    ) -> None:
        """Check everything, then make the run's folder below `runs`.

        `settings` are those of `pacesetter train ALGO ENV --help`; `config` is a file of them.
        """
        layers = [read_file(Path(config))] if config else []
        self.config = settle(algorithm, env, *layers, settings)
        self.directory = RunDirectory.of(runs, self.config)
        self.directory.refuse_existing(self.config)
        self.envs = self._make_envs()
        self.directory.create(self.config)
        self._set_up()
        checkpoint.save(self)
        self.notes: list[str] = []

    @classmethod
    def resume(
        cls,
        run: str | Path,
        *,
        runs: str | Path = "runs",
        steps: int | str | None = None,
        time: float | str | None = None,
    ) -> Self:
        """Take up a run where its last checkpoint left it, with a new budget if one is given."""
        self = cls.__new__(cls)
        self.directory = find(str(run), runs)
        self.config = self.directory.config()
        budgets = {"steps": steps, "time": time}
        changed = {key: value for key, value in budgets.items() if value is not None}
        if changed:
            settings = self.config.settings() | changed
            self.config = settle(self.config.run.algorithm, self.config.run.env, settings)
        self.envs = self._make_envs()
        self.directory.lock()
        try:
            self.directory.sweep()
            if changed:
                self.directory.write_config(self.config)
            self._set_up()
            self.notes = checkpoint.restore(self)
        except BaseException:
            self.directory.unlock()
            raise
        return self

    def __iter__(self) -> Iterator[Report]:
        """Train until the budget is spent, `stop` is called or the caller breaks; then save."""
        self._clock = Clock()
        self._saved_at = self.progress.wall_seconds
        try:
            while True:
                self._report()
                reports, self._reports = self._reports, []
                yield from reports
                if self.finished or self.stopping:
                    break
                if self._save_is_due():
                    self.save()
                self._collect()
                self._learn()
                self._turn()
                self.progress.tick += 1
        except GeneratorExit:
            self.save()
            raise
        else:
            self.save()
        finally:
            self.close()

    def stop(self) -> None:
        """Ask for the end after the running tick; may be called from a signal handler."""
        self.stopping = True

    @property
    def finished(self) -> bool:
        """Whether the budget of steps or time is spent."""
        limit = self.config.run.time
        if limit is not None and self.progress.wall_seconds >= limit:
            return True
        return self.progress.step >= self.budget

    def save(self) -> None:
        """Write a checkpoint now."""
        self._clock.tell(self.progress)
        checkpoint.save(self)
        self._saved_at = self.progress.wall_seconds

    def close(self) -> None:
        """Let go of envs, files and the folder."""
        for env in [*self.envs, *self._trial_envs.values()]:
            env.close()
        for replay in self.replays:
            replay.close()
        self.directory.unlock()

    def policy(self, member: int | None = None) -> Policy:
        """The policy of the champion, or of a member, as it is now."""
        chosen = self.progress.champion if member is None else member
        state = jax.tree.map(lambda x: x[chosen], self.states)
        actors = self.algorithm.policy(state)
        statistics = self.normalizer.statistics() if self.population.normalize else None
        run, env = self.config.run, self.envs[0]
        about = {
            "env": run.env,
            "env_kwargs": run.env_kwargs,
            "algorithm": run.algorithm,
            "name": run.name,
            "seed": run.seed,
            "step": self.progress.step,
            "versions": provenance()["versions"],
        }
        layers = unstack(actors)
        return Policy(
            layers, actors.activation, actors.output, env.low, env.high, statistics, about
        )

    # Set-up.

    def _make_envs(self) -> list[Environment]:
        run = self.config.run
        envs = [
            Environment(run.env, run.env_kwargs, run.seed, Stream.TRAIN, member)
            for member in range(run.members)
        ]
        envs[0].check()
        return envs

    def _set_up(self) -> None:
        run, hyper, first = self.config.run, self.config.hyper, self.envs[0]
        spec = Spec(first.observation_size, first.action_size)
        _prepare_jax(run.device)
        self.algorithm: Algorithm = algorithms.find(run.algorithm).build(spec, hyper)
        columns = Columns(*spec, self.algorithm.masks)
        self.population = Population(
            self.algorithm, columns, run.members, run.seed, hyper.normalize_observation
        )
        self.states = self.population.init(run.same_init)
        self.memory = self.population.new_memory(self.states)
        self.loss_names = self.population.loss_names(self.states)
        self.normalizer = Normalizer(spec.observation_size)
        self.budget = run.steps * self._unit
        count = 1 if run.replay_scope == "shared" else run.members
        self.replays = [
            Replay(
                self.directory.path / "last" / f"replay-{i}.bin",
                columns,
                hyper.replay_size,
                self.budget,
            )
            for i in range(count)
        ]
        self.warmup_streams = [generator(run.seed, Stream.WARMUP, k) for k in range(run.members)]
        self.sample_streams = [generator(run.seed, Stream.SAMPLE, k) for k in range(run.members)]
        self.rule_stream = generator(run.seed, Stream.RULE)
        self.streams = [*self.warmup_streams, *self.sample_streams, self.rule_stream]
        self.progress = Progress.of(run.members)
        self.stopping = False
        self._trial_envs: dict[Stream, Environment] = {}
        self._reports: list[Report] = []

    @property
    def _unit(self) -> int:
        run = self.config.run
        return run.members if run.count == "member" else 1

    # One tick.

    def _collect(self) -> None:
        """Every member in an episode acts and steps its own env, up to the budget."""
        progress, warmup = self.progress, self.config.hyper.warmup
        starting = [k for k, member in progress.each() if member.starting]
        for k in starting:
            self._start(k)
        self.memory = self.population.begin(self.states, self.memory, starting, progress.tick)
        acting = [k for k, member in progress.each() if member.active]
        acting = acting[: self.budget - progress.step]
        actions = self._explore() if progress.step + len(acting) > warmup else None
        for k in acting:
            if progress.step < warmup or actions is None:
                size = self.envs[k].action_size
                action = self.warmup_streams[k].uniform(-1, 1, size).astype(np.float32)
            else:
                action = actions[k]
            with _blame(k, progress.step):
                self._step(k, action)

    def _explore(self) -> Floats:
        observations = np.stack([env.observation for env in self.envs])
        statistics = self.normalizer.statistics()
        actions, self.memory = self.population.act(
            self.states, self.memory, observations, statistics, self.progress.tick
        )
        return actions

    def _start(self, k: int) -> None:
        member = self.progress.members[k]
        with _blame(k, self.progress.step):
            self.envs[k].reset()
        member.starting, member.active = False, True
        member.started = self.progress.step
        member.episode_return, member.episode_length = 0.0, 0

    def _step(self, k: int, action: Floats) -> None:
        member, env, hyper = self.progress.members[k], self.envs[k], self.config.hyper
        before = env.observation
        step = env.step(action)
        discount = hyper.gamma * (1.0 - step.terminated)
        self._replay(k).add(before, action, step.reward, step.observation, discount, step.ended)
        if self.population.normalize:
            self.normalizer.add(before)
        member.steps += 1
        member.episode_return += step.reward
        member.episode_length += 1
        if self.progress.step > hyper.warmup:
            member.owed += hyper.updates_per_step
        if step.ended:
            self._end(k)

    def _end(self, k: int) -> None:
        member = self.progress.members[k]
        member.active = False
        self.progress.episodes += 1
        self.progress.finished.append([k, member.episode_return, member.episode_length])
        if member.started >= self.config.hyper.warmup:
            member.window.append(member.episode_return)

    def _learn(self) -> None:
        """Every member that owes a cycle of updates makes it, on its own minibatches."""
        cycle, at_end = self.algorithm.cycle, self.config.hyper.update_at == "episode"

        def ready(member: Member) -> bool:
            return member.owed >= cycle and not (at_end and member.active)

        while members := [k for k, member in self.progress.each() if ready(member)]:
            self._update(members)

    def _update(self, members: list[int]) -> None:
        progress, cycle = self.progress, self.algorithm.cycle
        shape = (cycle, self.config.hyper.batch_size)
        samples = [self._replay(k).sample(self.sample_streams[k], shape) for k in members]
        rows = np.stack([sample.rows for sample in samples])
        weights = [sample.weight for sample in samples if sample.weight is not None]
        self.states, losses, errors = self.population.update(
            self.states,
            members,
            rows,
            np.stack(weights) if weights else None,
            self.normalizer.statistics(),
            progress.cycle,
        )
        self._note_losses(members, losses)
        for place, k in enumerate(members):
            self._replay(k).feedback(samples[place].slots, errors[place])
            progress.members[k].owed -= cycle
        progress.cycle += 1
        progress.updates += cycle * len(members)
        progress.transitions += rows.shape[0] * rows.shape[1] * rows.shape[2]

    def _note_losses(self, members: list[int], losses: Floats) -> None:
        progress = self.progress
        if not np.isfinite(losses).all():
            place, column = np.argwhere(~np.isfinite(losses))[0]
            raise TrainingError(
                f"member {members[place]}, step {progress.step}: {self.loss_names[column]} is "
                f"{losses[place, column]}; the last good checkpoint is in {self.directory.path}"
            )
        progress.losses = progress.losses or [[0.0] * (len(self.loss_names) + 1)]
        sums = progress.losses[0]
        for column, value in enumerate(losses.sum(axis=0, dtype=np.float64)):
            sums[column] += float(value)
        sums[-1] += len(members)

    def _turn(self) -> None:
        """Select where a round or an interval is over; send on the members that waited."""
        run, progress = self.config.run, self.progress
        ended = [k for k, member in progress.each() if not member.active]
        over = len(ended) == run.members if run.wait else bool(ended)
        if run.members > 1 and over and run.select_on == "train":
            self._select_on_train()
        if run.members > 1 and run.select_on == "eval":
            self._select_on_trials()
        if over:
            for k in ended:
                progress.members[k].starting = True

    # Selection.

    def _select_on_train(self) -> None:
        window = self.config.run.select_window
        members = self.progress.members
        if min(len(member.window) for member in members) < window:
            return
        self._select(np.array([member.window[-window:] for member in members]))
        for member in members:
            member.window = []

    def _select_on_trials(self) -> None:
        """Extra noise-free episodes with the same starts for each member; their steps count."""
        run, progress = self.config.run, self.progress
        every = run.select_every * self._unit
        if progress.step <= self.config.hyper.warmup or progress.step < progress.next_selection:
            return
        env, returns = self._trial_env(Stream.SELECT), []
        first = progress.selections * run.select_window
        for k in range(run.members):
            left = self.budget - progress.step
            with _blame(k, progress.step):
                trial = rollouts(self.policy(k).act, env, run.select_window, first, limit=left)
            progress.selection_steps += sum(trial.lengths)
            returns.append(trial.returns)
        if progress.step < self.budget:  # a selection that the budget cut short decides nothing
            self._select(np.array(returns))
        progress.next_selection = (progress.step // every + 1) * every

    def _select(self, returns: Any) -> None:
        """Copy by the rule's choice from returns (K, episodes); the winner is the champion."""
        run, progress = self.config.run, self.progress
        means = returns.mean(axis=1)
        parents = RULES[run.rule](means, self.rule_stream)
        if run.rule != "none":
            self.states = self.population.inherit(self.states, parents, run.copy)
            progress.champion = int(np.argmax(means[parents]))
        progress.selections += 1
        gap = measure(returns, progress.deviations)
        values = {
            "parents": parents.tolist(),
            "champion": progress.champion,
            "returns": returns.tolist(),
            "gap": gap.gap,
            "standard_error": gap.standard_error,
        }
        self._emit("select", values)

    # Evaluation, log and checkpoints.

    def _report(self) -> None:
        """Evaluate and log what is due."""
        progress = self.progress
        self._clock.tell(progress)
        if progress.step >= progress.next_train and progress.step > 0:
            self._report_training()
        every = self.config.run.eval_every * self._unit
        last = self.finished and progress.last_evaluation < progress.step
        if progress.step >= progress.next_evaluation or last:
            self._evaluate()
            progress.last_evaluation = progress.step
            progress.next_evaluation = (progress.step // every + 1) * every

    def _report_training(self) -> None:
        progress = self.progress
        values: dict[str, Any] = {"episodes_ended": progress.finished}
        for sums in progress.losses:
            values |= {name: sums[i] / sums[-1] for i, name in enumerate(self.loss_names)}
        progress.finished, progress.losses = [], []
        progress.next_train = (progress.step // TRAIN_ROW_EVERY + 1) * TRAIN_ROW_EVERY
        self._emit("train", values)

    def _evaluate(self) -> None:
        """Evaluate the champion on starts of its own and write the policy files."""
        run, progress = self.config.run, self.progress
        policy = self.policy()
        trial = self._trial(policy)
        score = {"score": trial.mean, "score_std": trial.std, "score_episodes": run.eval_episodes}
        policy.about.update(score)
        policy.save(self.directory.policy_file)
        if progress.step > 0 and (progress.best is None or trial.mean > progress.best):
            progress.best = trial.mean
            policy.about["score_note"] = "the best of many evaluations, so biased upwards"
            policy.save(self.directory.best_file)
        values = trial.table() | {"champion": progress.champion}
        if self.finished and run.rule == "none" and run.members > 1:
            values["members"] = [self._trial(self.policy(k)).mean for k in range(run.members)]
        self._emit("eval", values)

    def _trial(self, policy: Policy) -> Evaluation:
        with _blame(self.progress.champion, self.progress.step):
            episodes = self.config.run.eval_episodes
            return rollouts(policy.act, self._trial_env(Stream.EVALUATE), episodes)

    def _trial_env(self, stream: Stream) -> Environment:
        run = self.config.run
        if stream not in self._trial_envs:
            self._trial_envs[stream] = Environment(run.env, run.env_kwargs, run.seed, stream)
        return self._trial_envs[stream]

    def _emit(self, kind: str, values: dict[str, Any]) -> None:
        self._clock.tell(self.progress)
        report = Report(kind, self.progress.step, values, self.progress.ledger())
        self.directory.append(report.row())
        self._reports.append(report)

    def _save_is_due(self) -> bool:
        waited = self.progress.wall_seconds - self._saved_at
        full = any(replay.must_commit for replay in self.replays)
        return full or waited >= self.config.run.checkpoint_every

    def _replay(self, k: int) -> Replay:
        return self.replays[k % len(self.replays)]


class _blame:  # noqa: N801 (a context manager reads as a verb)
    """Name member and step in whatever an env does wrong."""

    def __init__(self, member: int, step: int) -> None:
        self.where = f"member {member}, step {step}"

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, Exception):
            raise TrainingError(f"{self.where}: {error}") from error


def _prepare_jax(device: str) -> None:
    """Choose the device and keep compiled programs, of which JAX stores none by default."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(home / "pacesetter"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if device != "auto":
        jax.config.update("jax_default_device", _device(device))


def _device(kind: str) -> Any:
    try:
        return jax.devices(kind)[0]
    except RuntimeError:
        present = ", ".join(sorted({device.platform for device in jax.devices()}))
        raise UsageError(f"device: this machine has no {kind}; it has {present}") from None

"""TD7: a second TD7 in plain NumPy, what is copied when, what acts, and tasks that it learns."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numeric import KEY, SPEC, close, member, near, random_batch, random_state, same, single
from short_runs import TINY, assert_same, run_to_end, run_to_step

from pacesetter.algorithms import td7
from pacesetter.batch import Spec
from pacesetter.config import resolve
from pacesetter.errors import UsageError
from pacesetter.networks import sale
from pacesetter.policy import Policy, load, unstack
from pacesetter.training.trainer import Trainer

SMALL: dict[str, Any] = {"hidden": (6, 5), "encoder_hidden": (7, 8), "encoder_size": 4}
TRAINED = ("actor", "critic", "encoder")
NETWORKS = (*TRAINED, "fixed_encoder", "target_actor", "target_critic", "target_encoder")


def learner(**hyper: Any) -> td7.TD7:
    return td7.TD7(SPEC, td7.Hyper(**{**SMALL, **hyper}))


def fresh(algorithm: td7.TD7, rng: np.random.Generator, **given: Any) -> Any:
    """A state in float64 whose networks are random, and so unlike their targets."""
    return random_state(algorithm, rng, *NETWORKS)._replace(**given)


# A second TD7, with derivatives by hand.


def relu(x: Any) -> tuple[Any, Any]:
    """Activations with their slopes."""
    return np.maximum(x, 0), (x > 0).astype(float)


def elu(x: Any) -> tuple[Any, Any]:
    below = np.exp(np.minimum(x, 0))
    return np.where(x > 0, x, below - 1), np.where(x > 0, 1, below)


def dense(layer: Any, x: Any) -> Any:
    return x @ layer["kernel"] + layer["bias"]


def dense_back(layer: Any, x: Any, g: Any) -> tuple[Any, Any]:
    """Gradients of the layer, and of its input."""
    return {"kernel": x.T @ g, "bias": g.sum(axis=0)}, g @ layer["kernel"].T


def chain(layers: Any, x: Any, activation: Any) -> tuple[Any, Any]:
    """The linear output of several layers, and what the way back needs."""
    tape = []
    for layer in layers[:-1]:
        after, slope = activation(dense(layer, x))
        tape.append((x, slope))
        x = after
    return dense(layers[-1], x), [*tape, (x, None)]


def chain_back(layers: Any, tape: Any, g: Any) -> tuple[list[Any], Any]:
    found: list[Any] = []
    for layer, (x, slope) in reversed(list(zip(layers, tape, strict=True))):
        gradient, g = dense_back(layer, x, g if slope is None else g * slope)
        found.insert(0, gradient)
    return found, g


def norm(x: Any) -> Any:
    return x / np.abs(x).mean(axis=1, keepdims=True)


def norm_back(x: Any, g: Any) -> Any:
    """y_i = x_i / m with m = sum_j |x_j| / n."""
    m, n = np.abs(x).mean(axis=1, keepdims=True), x.shape[1]
    return g / m - np.sign(x) * (g * x).sum(axis=1, keepdims=True) / (n * m**2)


class Encoding:
    """Both embeddings of (s, a), and the gradients of the encoder and of a."""

    def __init__(self, encoder: Any, s: Any, a: Any) -> None:
        self.encoder = encoder
        self.raw, self.state_tape = chain(encoder.state, s, elu)
        self.zs = norm(self.raw)
        together = np.concatenate([self.zs, a], axis=1)
        self.zsa, self.action_tape = chain(encoder.action, together, elu)

    def back(self, g: Any) -> tuple[Any, Any]:
        action, below = chain_back(self.encoder.action, self.action_tape, g)
        size = self.zs.shape[1]
        g = norm_back(self.raw, below[:, :size])
        state, _ = chain_back(self.encoder.state, self.state_tape, g)
        return sale.Encoder(state, action), below[:, size:]


class Embedded:
    """The output of an actor or critic, and the gradients of its layers and of all it read."""

    def __init__(self, network: Any, x: Any, embeddings: list[Any], activation: Any) -> None:
        self.network, self.x = network, x
        self.raw = dense(network[0], x)
        together = np.concatenate([norm(self.raw), *embeddings], axis=1)
        self.out, self.tape = chain(network[1:], together, activation)

    def back(self, g: Any) -> tuple[list[Any], Any, Any]:
        rest, below = chain_back(self.network[1:], self.tape, g)
        width = self.raw.shape[1]
        first, x = dense_back(self.network[0], self.x, norm_back(self.raw, below[:, :width]))
        return [first, *rest], x, below[:, width:]


class Adam:
    """Adam with its textbook formulas on a tree of arrays."""

    def __init__(self, tree: Any, rate: float) -> None:
        self.rate, self.steps = rate, 0
        self.first = self.second = jax.tree.map(np.zeros_like, tree)

    def step(self, tree: Any, gradient: Any) -> Any:
        self.steps += 1
        self.first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, self.first, gradient)
        self.second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, self.second, gradient)

        def moved(p: Any, m: Any, v: Any) -> Any:
            mean, square = m / (1 - 0.9**self.steps), v / (1 - 0.999**self.steps)
            return p - self.rate * mean / (np.sqrt(square) + 1e-8)

        return jax.tree.map(moved, tree, self.first, self.second)


class Reference:
    """TD7 in float64, update by update; a critic is a list of layers."""

    def __init__(self, algorithm: td7.TD7, state: Any) -> None:
        self.hyper = hyper = algorithm.hyper

        def plain(network: Any) -> Any:
            lists = jax.tree.map(np.array, network)
            return sale.Encoder(*map(list, lists)) if isinstance(lists, sale.Encoder) else [*lists]

        nets = {name: plain(getattr(state, name)) for name in NETWORKS}
        for name in ("critic", "target_critic"):
            nets[name] = [[*member(tuple(nets[name]), i)] for i in range(hyper.critics)]
        self.nets = nets
        rates = {"actor": hyper.actor_learning_rate, "critic": hyper.critic_learning_rate}
        rates["encoder"] = hyper.encoder_learning_rate
        self.adams = {name: Adam(nets[name], rates[name]) for name in TRAINED}
        self.seen, self.range = [1e8, -1e8], [0.0, 0.0]
        self.updates = 0
        self.errors: list[Any] = []

    def move(self, name: str, gradient: Any) -> None:
        self.nets[name] = self.adams[name].step(self.nets[name], gradient)

    def update(self, batches: Any, noise: list[Any]) -> None:
        """One cycle on (U, B, ...) with the given unclipped smoothing noise of each update."""
        self.errors = []
        for u, draw in enumerate(noise):
            batch = member(batches, u)
            self.encoder_step(batch)
            self.critic_step(batch, self.target(batch, draw))
            self.updates += 1
        self.actor_step(member(batches, len(noise) - 1))
        since = range(self.updates - len(noise) + 1, self.updates + 1)
        if any(update % self.hyper.copy_every == 0 for update in since):
            nets = self.nets
            nets["target_actor"], nets["target_critic"] = nets["actor"], nets["critic"]
            nets["target_encoder"] = nets["fixed_encoder"]
            nets["fixed_encoder"] = nets["encoder"]
            self.range = list(self.seen)

    def encoder_step(self, batch: Any) -> None:
        encoder = self.nets["encoder"]
        wanted = norm(chain(encoder.state, batch.next_observation, elu)[0])
        at = Encoding(encoder, batch.observation, batch.action)
        self.move("encoder", at.back(2 * (at.zsa - wanted) / wanted.size)[0])

    def target(self, batch: Any, noise: Any) -> Any:
        nets, limit, s = self.nets, self.hyper.target_noise_clip, batch.next_observation
        zs = norm(chain(nets["target_encoder"].state, s, elu)[0])
        action = np.tanh(Embedded(nets["target_actor"], s, [zs], relu).out)
        action = np.clip(action + np.clip(noise, -limit, limit), -1, 1)
        at = Encoding(nets["target_encoder"], s, action)
        x = np.concatenate([s, action], axis=1)
        values = [Embedded(c, x, [at.zsa, at.zs], elu).out for c in nets["target_critic"]]
        clipped = np.clip(np.min(values, axis=0)[:, 0], *self.range)
        y = batch.reward + batch.discount * clipped
        self.seen = [min(self.seen[0], y.min()), max(self.seen[1], y.max())]
        return y

    def critic_step(self, batch: Any, y: Any) -> None:
        at = Encoding(self.nets["fixed_encoder"], batch.observation, batch.action)
        x = np.concatenate([batch.observation, batch.action], axis=1)
        gradients, errors = [], []
        for critic in self.nets["critic"]:
            found = Embedded(critic, x, [at.zsa, at.zs], elu)
            error = found.out[:, 0] - y
            slope = error if self.hyper.replay == "uniform" else np.clip(error, -1, 1)
            slope = slope * (2 if self.hyper.replay == "uniform" else 1) * batch.weight / len(y)
            gradients.append(found.back(slope[:, None])[0])
            errors.append(np.abs(error))
        self.move("critic", gradients)
        self.errors.append(np.max(errors, axis=0))

    def actor_step(self, batch: Any) -> None:
        s, encoder, actor = batch.observation, self.nets["fixed_encoder"], self.nets["actor"]
        zs = norm(chain(encoder.state, s, elu)[0])
        said = Embedded(actor, s, [zs], relu)
        action = np.tanh(said.out)
        at = Encoding(encoder, s, action)
        x = np.concatenate([s, action], axis=1)
        up = np.full((len(s), 1), -1 / (len(s) * self.hyper.critics))
        slope = np.zeros_like(action)
        for critic in self.nets["critic"]:
            _, into, embeddings = Embedded(critic, x, [at.zsa, at.zs], elu).back(up)
            size = zs.shape[1]
            slope += into[:, s.shape[1] :] + at.back(embeddings[:, :size])[1]
        self.move("actor", said.back(slope * (1 - action**2))[0])


CASES: dict[str, dict[str, Any]] = {
    "td7": {},
    "three-critics": {"policy_delay": 3, "critics": 3, "target_noise": 0.0, "copy_every": 6},
    "uniform": {"replay": "uniform"},
    "copies-within-cycles": {"policy_delay": 3, "copy_every": 4},
}


@pytest.mark.parametrize("case", CASES)
def test_cycles_equal_a_reference_in_numpy(case: str, rng: np.random.Generator) -> None:
    """In float64 five cycles, with copies between them, agree to 1e-9 in every parameter."""
    rates = {
        f"{name}_learning_rate": r for name, r in zip(TRAINED, (1e-3, 2e-3, 3e-3), strict=True)
    }
    algorithm = learner(**{"copy_every": 4, **rates, **CASES[case]})
    hyper, delay = algorithm.hyper, algorithm.updates_per_call
    clipped = False
    with jax.enable_x64(True):
        state = fresh(algorithm, rng)
        reference = Reference(algorithm, state)
        step = jax.jit(algorithm.update)
        for cycle in range(5):
            batch, key = random_batch(rng, SPEC, delay, 16), jax.random.key(cycle)
            noise = [
                hyper.target_noise * np.asarray(jax.random.normal(k, (16, 2)))
                for k in jax.random.split(key, delay)
            ]
            state, _, td_error = jax.device_get(step(state, batch, key))
            reference.update(batch, noise)
            same_as(state, reference)
            close(td_error, np.array(reference.errors), rtol=1e-9)
            clipped |= reference.range != [0, 0]
    assert clipped
    assert state.updates == 5 * delay


def same_as(state: Any, reference: Reference) -> None:
    for name, expected in reference.nets.items():
        found = getattr(state, name)
        if "critic" in name:
            for i, critic in enumerate(expected):
                close([*member(found, i)], critic, rtol=1e-9, atol=1e-11)
        elif "encoder" in name:
            for one, other in zip(found, expected, strict=True):
                close([*one], other, rtol=1e-9, atol=1e-11)
        else:
            close([*found], expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(state.seen, reference.seen, rtol=1e-9)
    np.testing.assert_allclose(state.value_range, reference.range, rtol=1e-9)


def test_the_reference_has_the_right_derivatives(rng: np.random.Generator) -> None:
    """The norm's slope by differences: what the reference itself could have wrong."""
    x, g = rng.normal(size=(2, 4, 5))
    for index in np.ndindex(x.shape):
        near = np.zeros_like(x)
        near[index] = 1e-6
        slope = ((norm(x + near) - norm(x - near)) * g).sum() / 2e-6
        assert norm_back(x, g)[index] == pytest.approx(slope, rel=1e-5, abs=1e-8)


# What is copied when, and what no step moves.


def test_targets_are_copied_every_250_updates(rng: np.random.Generator) -> None:
    """Not at the 248th; at the 250th, the target encoder from the fixed one of before."""
    algorithm = learner()
    batch = single(random_batch(rng, SPEC, 2, 8))
    old = single(fresh(algorithm, rng, updates=np.int32(246)))
    step = jax.jit(algorithm.update)
    before = jax.device_get(step(old, batch, KEY).state)
    for name in ("fixed_encoder", "target_actor", "target_critic", "target_encoder", "value_range"):
        assert same(getattr(before, name), getattr(old, name))
    after = jax.device_get(step(before, batch, KEY).state)
    for name in ("actor", "critic"):
        assert same(getattr(after, f"target_{name}"), getattr(after, name))
        assert not same(getattr(after, name), getattr(before, name))
    assert same(after.fixed_encoder, after.encoder)
    assert same(after.target_encoder, before.fixed_encoder)
    assert same(after.value_range, after.seen)
    assert after.seen[0] < after.seen[1]


def test_next_values_stay_in_the_range_of_earlier_targets(rng: np.random.Generator) -> None:
    """Of huge values only the range's ends come through; before the first copy nothing does."""
    algorithm = learner()
    state = single(fresh(algorithm, rng))
    *rest, last = state.target_critic
    state = state._replace(target_critic=(*rest, last | {"bias": last["bias"] + np.float32(1e6)}))
    batch = single(member(random_batch(rng, SPEC, 1, 16), 0))
    for low, high in ((0, 0), (-2, 3)):
        limited = state._replace(value_range=np.array([low, high], np.float32))
        y = jax.jit(algorithm.target)(limited, batch, KEY)
        np.testing.assert_allclose(y, batch.reward + batch.discount * high, rtol=1e-5, atol=1e-6)


def test_each_loss_moves_its_own_networks(rng: np.random.Generator) -> None:
    """The encoder learns from its loss alone; critics and actor leave what they see."""
    algorithm = learner()
    old = single(fresh(algorithm, rng))
    batch = single(member(random_batch(rng, SPEC, 1, 8), 0))
    steps = {
        "encoder": jax.jit(algorithm.fit_encoder)(old, batch)[0],
        "critic": jax.jit(algorithm.fit_critic)(old, batch, batch.reward)[0],
        "actor": jax.jit(algorithm.fit_actor)(old, batch)[0],
    }
    for moved, new in steps.items():
        changed = {n for n in NETWORKS if not same(getattr(old, n), getattr(new, n))}
        assert changed == {moved}


def test_learner_uses_no_key_twice(rng: np.random.Generator) -> None:
    algorithm = learner()
    batch = single(random_batch(rng, SPEC, 2, 7))
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(algorithm.init), KEY)
        jax.eval_shape(jax.jit(algorithm.update), state, batch, KEY)


def test_learners_begin_as_they_should() -> None:
    """Weights fill +-1/sqrt(inputs); twins apart; targets and both fixed encoders are copies."""
    state = jax.jit(td7.TD7(Spec(40, 30), td7.Hyper()).init)(KEY)
    fans = {"actor": [40, 512, 256, 256], "critic": [70, 768, 256, 256]}
    for name, sizes in fans.items():
        for layer, fan_in in zip(getattr(state, name), sizes, strict=True):
            assert layer["kernel"].shape[-2] == fan_in
            assert 0.8 < np.abs(layer["kernel"]).max() * fan_in**0.5 <= 1 + 1e-6
    for layer in state.critic:
        assert np.all(layer["kernel"][0] != layer["kernel"][1])
    for one, other in (
        (state.actor, state.target_actor),
        (state.critic, state.target_critic),
        (state.encoder, state.fixed_encoder),
        (state.encoder, state.target_encoder),
    ):
        assert same(one, other)
    np.testing.assert_array_equal(state.value_range, [0, 0])


def test_copies_between_members(rng: np.random.Generator) -> None:
    """`weights` leaves a member its three Adams; an actor alone is refused in one line."""
    algorithm = learner()
    own, parent = single(fresh(algorithm, rng)), single(fresh(algorithm, rng))
    own = own._replace(updates=np.int32(5))
    parent = parent._replace(
        encoder_opt_state=jax.tree.map(lambda x: x + 1, parent.encoder_opt_state)
    )
    new = algorithm.copy_weights(own, parent)
    for name in (*NETWORKS, "seen", "value_range"):
        assert same(getattr(new, name), getattr(parent, name))
    for name in ("actor_opt_state", "critic_opt_state", "encoder_opt_state", "updates"):
        assert same(getattr(new, name), getattr(own, name))
    with pytest.raises(UsageError, match="allowed: full, weights"):
        algorithm.copy_actor(own, parent)


# What acts.


def test_policy_file_acts_as_the_learner(rng: np.random.Generator, tmp_path: Path) -> None:
    """NumPy, from the file, equals JAX with the fixed encoder; exploration adds its noise."""
    algorithm = learner()
    state = single(fresh(algorithm, rng))
    observation = rng.normal(size=(50, 3)).astype(np.float32)

    def wanted(state: Any) -> Any:
        zs = sale.zs(state.fixed_encoder, observation)
        return sale.action(state.actor, observation, zs)

    expected = np.asarray(jax.jit(wanted)(state))
    actors, box = algorithm.policy(state), np.ones(2, np.float32)
    Policy(unstack(actors.layers), actors.activation, actors.output, -box, box).save(tmp_path / "p")
    policy = load(tmp_path / "p")
    np.testing.assert_allclose(policy(observation), expected, atol=1e-5)
    params = jax.device_get(jax.jit(algorithm.policy_params)(state))
    noise = np.random.default_rng(1).standard_normal(2, np.float32)
    action, _ = algorithm.act(params, (), observation[0], np.random.default_rng(1))
    np.testing.assert_allclose(action, expected[0] + 0.1 * noise, atol=1e-5)
    one = jax.jit(wanted)(state._replace(encoder=single(fresh(algorithm, rng)).encoder))
    np.testing.assert_array_equal(one, expected)  # the encoder that learns has no say


@pytest.mark.parametrize("name", ["encoder_kernel_2", "encoder_bias_3", "kernel"])
def test_a_damaged_encoder_is_refused(name: str, rng: np.random.Generator, tmp_path: Path) -> None:
    """A stage of the wrong shape, or with a part missing, is one line."""
    algorithm = learner()
    layers, box = (
        unstack(algorithm.policy(single(fresh(algorithm, rng))).layers),
        np.ones(2, np.float32),
    )
    first = layers[0][0]
    cut = first | {name: first[name][:-1]}
    missing = {key: value for key, value in first.items() if key != name}
    for wrong in (cut, missing):
        Policy([[wrong, *layers[0][1:]]], "relu", "tanh", -box, box).save(tmp_path / "p")
        with pytest.raises(UsageError, match="damaged policy"):
            load(tmp_path / "p")


# Whole runs.

RUN: dict[str, Any] = TINY | {"encoder_hidden": (12, 12), "encoder_size": 8, "steps": 600}


def test_a_run_that_was_stopped_goes_on_exactly(runs: Path) -> None:
    """Stopped between assessments and resumed, it equals the run that was not, bit for bit."""
    settings = RUN | {"copy_every": 50, "assess": 2, "assess_after": 100, "eval_every": 200}
    whole = Trainer("td7", "probe_envs:Scripted-v0", runs=runs, name="whole", **settings)
    directory = run_to_end(whole)
    assert [row for row in directory.rows() if row.get("assessed")]
    halves = Trainer("td7", "probe_envs:Scripted-v0", runs=runs, name="halves", **settings)
    run_to_step(halves, 357)
    assert not halves.finished
    assert_same(directory, run_to_end(Trainer.resume(halves.directory.path)))


def test_two_members(runs: Path, nans_raise: None) -> None:
    """multi-td7 selects, copies and finishes; its policy acts."""
    settings = RUN | {"members": 2, "assess": 0, "copy": "weights"}
    trainer = Trainer("multi-td7", "probe_envs:Scripted-v0", runs=runs, **settings)
    rows = run_to_end(trainer).rows()
    assert rows[-1]["step"] == 600
    assert [row for row in rows if row["kind"] == "select"]
    policy = trainer.policy()
    assert np.isfinite(policy(np.zeros(policy.observation_size))).all()


LEARNS: dict[str, Any] = TINY | {
    "hidden": (64, 64),
    "encoder_hidden": (32, 32),
    "encoder_size": 16,
    "copy_every": 50,
    "batch_size": 64,
    "steps": 1_500,
    "warmup": 200,
    "gamma": 0.5,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "encoder_learning_rate": 1e-3,
    "exploration_noise": 0.5,
    "assess": 0,
    "eval_every": 10_000,
}


def learned(env: str, runs: Path, **kwargs: Any) -> tuple[Trainer, Any]:
    """A trainer that has learned, and every critic's value (critics, n) of (states, actions)."""
    trainer = Trainer("td7", f"probe_envs:{env}", runs=runs, env_kwargs=kwargs, **LEARNS)
    run_to_end(trainer)
    state, algorithm = trainer.loop.learners.states[0], trainer.loop.learners.compiled.learner

    def values(observations: Any, actions: Any) -> Any:
        s, a = (np.array(x, np.float32)[:, None] for x in (observations, actions))
        zs = sale.zs(state.fixed_encoder, s)
        return algorithm.values(state.critic, state.fixed_encoder, s, zs, a)

    return trainer, values


def test_it_learns_the_action_that_fits_what_is_seen(runs: Path) -> None:
    """Reward -4 (a - s/2)^2 for s = -1 or 1."""
    trainer, values = learned("BothReward-v0", runs)
    near(trainer.policy()(np.array([[-1], [1]])), [[-0.5], [0.5]])
    near(values([-1, 1, 1], [-0.5, 0.5, 0.0]), [0, 0, -1])


def test_it_learns_that_a_fall_is_the_end(runs: Path) -> None:
    """Reward 1 for 3 steps is worth 1 + .5 + .25, then less."""
    _, values = learned("Corridor-v0", runs, falls_at=3)
    near(values([0, 1, 2], [0, 0, 0]), [1.75, 1.5, 1])


def test_presets() -> None:
    """Defaults are the reference's; the small one has narrower encoders, batches and warm-up."""
    hyper = resolve("td7", "Walker2d-v5").hyper
    assert (hyper.hidden, hyper.encoder_hidden, hyper.encoder_size) == ((256, 256), (256, 256), 256)
    assert (hyper.batch_size, hyper.copy_every, hyper.policy_delay) == (256, 250, 2)
    assert (hyper.replay, hyper.exponents, hyper.assess) == ("lap", (0.4, 0.0), 20)
    assert (hyper.warmup, hyper.exploration_noise) == (25_000, 0.1)
    small = resolve("td7-small", "Walker2d-v5").hyper
    assert (small.batch_size, small.encoder_hidden, small.encoder_size) == (128, (96, 96), 96)
    assert small.warmup == 5_000


def test_a_copy_that_td7_cannot_make_is_refused_before_anything_is_written(runs: Path) -> None:
    settings = RUN | {"members": 2, "rule": "best", "copy": "actor"}
    with pytest.raises(UsageError, match="copy: an actor of td7 reads its own encoder"):
        Trainer("td7", "Pendulum-v1", runs=runs, **settings)
    assert not runs.exists()

"""TD3 and DDPG: golden numbers, a second TD3 in plain NumPy, and what must leave what alone."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from learners import fresh, learner
from numeric import KEY, SPEC, all_differ, member, random_batch, same, single
from short_runs import TINY, run_to_end

from pacesetter import algorithms
from pacesetter.algorithms.td3 import TD3, State
from pacesetter.batch import Batch, Spec
from pacesetter.config import resolve
from pacesetter.evaluation import evaluate
from pacesetter.networks import mlp
from pacesetter.policy import Policy, load, to_env, unstack
from pacesetter.training.trainer import Trainer

ORIGINAL = {"action_layer": 1, "critic_decay": 1e-2, "output_bound": 3e-3}
Nets = list[dict[str, Any]]
Minibatches = Callable[..., Batch]

# Compiled once for each learner and shape; they take and give plain NumPy arrays.


def _compiled(method: Callable[..., Any]) -> Callable[..., Any]:
    inner = jax.jit(method, static_argnums=0)
    return lambda *arguments: jax.device_get(inner(*arguments))


def _asked(algorithm: TD3, state: State, batch: Batch, key: Any) -> list[Any]:
    seen: list[Any] = []

    class Spy(TD3):
        def outputs(self, critic: Any, observation: Any, action: Any) -> Any:
            seen.append(action)
            return super().outputs(critic, observation, action)

    Spy(algorithm.spec, algorithm.hyper).target(state, batch, key)
    return seen


init = _compiled(TD3.init)
update = _compiled(TD3.update)
target = _compiled(TD3.target)
fit_critic = _compiled(TD3.fit_critic)
fit_actor = _compiled(TD3.fit_actor)
update_targets = _compiled(TD3.update_targets)
values = _compiled(TD3.values)
asked = _compiled(_asked)


def constant(tree: Any, value: float) -> Any:
    return jax.tree.map(lambda x: np.full_like(x, value), tree)


def with_bias(network: Any, bias: Any) -> Any:
    """A network that gives its last bias everywhere."""
    *hidden, last = constant(network, 0)
    last["bias"] = np.broadcast_to(np.float32(bias), last["bias"].shape)
    return (*hidden, last)


@pytest.fixture
def minibatches(rng: np.random.Generator) -> Minibatches:
    """Batches of random transitions, some of them terminal, with uneven weights."""

    def make(*shape: int) -> Batch:
        return single(random_batch(rng, SPEC, *shape))

    return make


# The target.


def test_target_of_terminal_and_truncated_steps(minibatches: Minibatches) -> None:
    """r + gamma * min of the twins, nothing after a terminal step, all after a truncated one."""
    algorithm = learner()
    state = fresh(algorithm)
    state = state._replace(target_critic=with_bias(state.target_critic, [[10], [7]]))
    batch = minibatches(16)._replace(reward=np.full(16, 1.5, np.float32))
    batch.discount[:3] = 0.99, 0, 0.99  # running, terminal, truncated
    batch.last[:3] = 0, 1, 1
    y = target(algorithm, state, batch, KEY)
    np.testing.assert_allclose(y[:3], [8.43, 1.5, 8.43], rtol=1e-6)


def test_minimum_is_taken_sample_by_sample(
    minibatches: Minibatches, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Either twin may be the smaller one."""
    given = np.array([[1, 5, -3], [2, 4, -4]], np.float32)
    monkeypatch.setattr(TD3, "outputs", lambda *_: given[..., None])
    batch = minibatches(3)._replace(reward=np.zeros(3), discount=np.ones(3))
    algorithm = learner()
    y = jax.jit(algorithm.target)(fresh(algorithm), batch, KEY)
    np.testing.assert_array_equal(y, [1, 4, -4])


def test_no_gradient_flows_through_the_target(minibatches: Minibatches) -> None:
    """Neither to the target networks nor to the rewards."""
    algorithm, batch = learner(), minibatches(16)
    state = fresh(algorithm)

    def total(actor: Any, critic: Any, reward: Any) -> Any:
        changed = state._replace(target_actor=actor, target_critic=critic)
        return algorithm.target(changed, batch._replace(reward=reward), KEY).sum()

    slope = jax.jit(jax.grad(total, (0, 1, 2)))
    gradient = slope(state.target_actor, state.target_critic, batch.reward)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))


def target_actions(clean: float, batch: Batch, **hyper: Any) -> Any:
    """The actions (B, A) at which `target` asks its critics if the target actor says `clean`."""
    algorithm = learner(**hyper)
    state = fresh(algorithm)
    state = state._replace(target_actor=with_bias(state.target_actor, np.arctanh(clean)))
    (actions,) = asked(algorithm, state, batch, KEY)  # one for all critics
    assert actions.shape == batch.action.shape  # and one a sample
    return actions


def test_smoothing_noise_is_clipped_at_half_a_unit(minibatches: Minibatches) -> None:
    """Noise that is all out of range adds exactly +-.5, which is +-.2 on Humanoid's box."""
    actions = target_actions(0.0, minibatches(64), target_noise=1e6)
    assert set(np.unique(actions)) == {-0.5, 0.5}
    low, high = np.full(2, -0.4, np.float32), np.full(2, 0.4, np.float32)
    np.testing.assert_allclose(np.abs(to_env(actions, low, high)), 0.2, rtol=1e-6)


def test_smoothed_actions_stay_in_range(minibatches: Minibatches) -> None:
    """From .8 the noise leads to .3 or to 1, not to 1.3."""
    actions = target_actions(0.8, minibatches(64), target_noise=1e6)
    low = actions < 0.5
    np.testing.assert_allclose(actions[low], 0.3, rtol=1e-6)
    assert np.all(actions[~low] == 1)
    assert 0 < low.sum() < low.size


def test_smoothing_noise_is_drawn_for_each_number(minibatches: Minibatches) -> None:
    """No two samples or dimensions share a draw, and its deviation is .2 to 5 standard errors."""
    noise = target_actions(0.0, minibatches(4000), target_noise_clip=100.0)
    noise = noise[np.all(np.abs(noise) < 1, axis=1)]
    assert len(noise) > 3990
    assert len(np.unique(noise)) > 0.999 * noise.size
    assert abs(noise.mean()) < 5 * 0.2 / 8000**0.5
    assert abs(noise.std() - 0.2) < 5 * 0.2 / 16000**0.5
    assert abs(np.corrcoef(noise.T)[0, 1]) < 5 / 4000**0.5


# When what moves.


@pytest.mark.parametrize("delay", [2, 3])
def test_actor_and_targets_move_once_a_cycle(delay: int, minibatches: Minibatches) -> None:
    """5 cycles: critics move `delay` times each, the actor once, every target one soft step."""
    algorithm = learner(policy_delay=delay)
    state = fresh(algorithm)
    for cycle in range(5):
        old = state
        state = update(algorithm, old, minibatches(delay, 16), jax.random.key(cycle)).state
        for name in ("actor", "critic"):
            before, new = getattr(old, f"target_{name}"), getattr(state, name)
            after = getattr(state, f"target_{name}")
            expected = jax.tree.map(lambda t, x: 0.995 * t + 0.005 * x, before, new)
            jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-7), after, expected)
            assert all_differ(before, after)
    assert state.updates == 5 * delay
    assert optimizer_count(state.actor_opt_state) == 5
    assert optimizer_count(state.critic_opt_state) == 5 * delay


def optimizer_count(moments: Any) -> int:
    """Steps that an Adam has made."""
    (count,) = [x for x in jax.tree.leaves(moments) if np.issubdtype(x.dtype, np.integer)]
    return int(count)


def test_targets_follow_by_polyak_averaging() -> None:
    """From 0 towards networks that stay at 1, 100 soft steps reach 1 - .995^100 = .394230."""
    algorithm = learner()
    state = fresh(algorithm)
    state = state._replace(
        actor=constant(state.actor, 1),
        critic=constant(state.critic, 1),
        target_actor=constant(state.target_actor, 0),
        target_critic=constant(state.target_critic, 0),
    )
    for _ in range(100):
        state = update_targets(algorithm, state)
    for leaf in jax.tree.leaves((state.target_actor, state.target_critic)):
        np.testing.assert_allclose(leaf, 0.394230, atol=1e-6)


def test_fitting_the_actor_leaves_the_rest(minibatches: Minibatches) -> None:
    """Critics, their moments, all targets and the counter are the same bits afterwards."""
    algorithm = learner()
    old = fresh(algorithm)
    new, _ = fit_actor(algorithm, old, minibatches(16))
    for part in ("critic", "critic_opt_state", "target_actor", "target_critic", "updates"):
        assert same(getattr(old, part), getattr(new, part))
    assert all_differ(old.actor, new.actor)


def test_fitting_the_critics_leaves_the_rest(minibatches: Minibatches) -> None:
    """The actor and all targets are the same bits afterwards."""
    algorithm, batch = learner(), minibatches(16)
    old = fresh(algorithm)
    new, *_ = fit_critic(algorithm, old, batch, batch.reward, batch.weight)
    for part in ("actor", "actor_opt_state", "target_actor", "target_critic"):
        assert same(getattr(old, part), getattr(new, part))
    assert all_differ(old.critic, new.critic)


@pytest.mark.parametrize("kept", [0, 1])
def test_a_critic_learns_nothing_from_its_twin(kept: int, minibatches: Minibatches) -> None:
    """For a given target, another twin changes not one bit of a critic's step or moments."""
    algorithm, batch = learner(), minibatches(16)
    state, other = fresh(algorithm), fresh(algorithm, seed=1)
    mixed = jax.tree.map(np.copy, other.critic)
    jax.tree.map(lambda to, a: to.__setitem__(kept, a[kept]), mixed, state.critic)
    one, *_ = fit_critic(algorithm, state, batch, batch.reward, batch.weight)
    state = state._replace(critic=mixed)
    two, *_ = fit_critic(algorithm, state, batch, batch.reward, batch.weight)
    assert same(member(one.critic, kept), member(two.critic, kept))
    assert all_differ(member(one.critic, 1 - kept), member(two.critic, 1 - kept))
    moments = [[x[kept] for x in jax.tree.leaves(s.critic_opt_state) if x.ndim] for s in (one, two)]
    assert same(*moments)


def test_a_critic_knows_its_twin_only_by_the_minimum(minibatches: Minibatches) -> None:
    """The twin's target acts where it is the smaller one, and nowhere if it never is."""
    algorithm, batch = learner(), minibatches(2, 16)
    state = fresh(algorithm)

    def shifted(by: float) -> Any:
        *hidden, last = state.target_critic
        bias = last["bias"] + np.array([[0], [by]], np.float32)
        changed = state._replace(target_critic=(*hidden, last | {"bias": bias}))
        return member(update(algorithm, changed, batch, KEY).state.critic, 0)

    assert same(shifted(1e3), shifted(2e3))
    assert all_differ(shifted(-1e3), shifted(1e3))


# How learners begin.


@pytest.mark.parametrize(("name", "hyper"), [("td3", {}), ("ddpg", ORIGINAL)])
def test_learners_begin_as_they_should(name: str, hyper: dict[str, Any]) -> None:
    """Weights fill +-1/sqrt(inputs of the layer); twins begin apart, targets as copies."""
    state = init(learner(name, Spec(40, 30), hidden=(300, 200), **hyper), KEY)
    joins = hyper.get("action_layer", 0)
    critic_fans = [size + 30 * (i == joins) for i, size in enumerate((40, 300, 200))]
    for network, fans in ((state.actor, [40, 300, 200]), (state.critic, critic_fans)):
        for depth, (layer, fan_in) in enumerate(zip(network, fans, strict=True)):
            assert layer["kernel"].shape[-2] == fan_in
            bound = hyper.get("output_bound", fan_in**-0.5) if depth == 2 else fan_in**-0.5
            assert 0.9 < np.abs(layer["kernel"]).max() / bound <= 1 + 1e-6
            assert 0 < np.abs(layer["bias"]).max() / bound <= 1 + 1e-6
            if layer["kernel"].size > 10_000:
                np.testing.assert_allclose(layer["kernel"].var() / bound**2, 1 / 3, rtol=0.03)
    assert same(state.actor, state.target_actor)
    assert same(state.critic, state.target_critic)
    if name == "td3":
        assert all_differ(member(state.critic, 0), member(state.critic, 1))


# A second TD3, by hand.


class Adam:
    """Adam with its textbook formulas on a list of arrays."""

    def __init__(self, network: Nets, rate: float, decay: float = 0.0) -> None:
        self.network, self.rate, self.decay, self.steps = network, rate, decay, 0
        self.first = [{k: np.zeros_like(v) for k, v in layer.items()} for layer in network]
        self.second = [{k: np.zeros_like(v) for k, v in layer.items()} for layer in network]

    def step(self, gradient: Nets) -> None:
        self.steps += 1
        for i, layer in enumerate(self.network):
            for name in layer:
                g = gradient[i][name] + self.decay * layer[name]
                self.first[i][name] = 0.9 * self.first[i][name] + 0.1 * g
                self.second[i][name] = 0.999 * self.second[i][name] + 0.001 * g**2
                mean = self.first[i][name] / (1 - 0.9**self.steps)
                root = np.sqrt(self.second[i][name] / (1 - 0.999**self.steps))
                layer[name] = layer[name] - self.rate * mean / (root + 1e-8)


def forward(network: Nets, x: Any, action: Any, joins: int) -> tuple[Any, list[Any]]:
    """Output (B, outputs) and what the way back needs; `action` joins the input of one layer."""
    tape: list[Any] = []
    for i, layer in enumerate(network):
        if action is not None and i == joins:
            x = np.concatenate([x, action], axis=1)
        z = x @ layer["kernel"] + layer["bias"]
        normed, root = z, 1.0
        if "scale" in layer:
            root = np.sqrt(z.var(axis=1, keepdims=True) + 1e-5)
            normed = (z - z.mean(axis=1, keepdims=True)) / root
            z = normed * layer["scale"] + layer["offset"]
        tape.append((x, normed, root, z > 0))
        x = z if i == len(network) - 1 else z * (z > 0)
    return x, tape


def backward(network: Nets, tape: list[Any], g: Any, joins: int, actions: int) -> tuple[Nets, Any]:
    """Gradient of every parameter, and of the action, from the output's gradient g (B, outputs)."""
    found: Nets = []
    action_gradient = None
    for i in reversed(range(len(network))):
        layer, (x, normed, root, positive) = network[i], tape[i]
        g = g if i == len(network) - 1 else g * positive
        here = {}
        if "scale" in layer:
            here = {"scale": (g * normed).sum(axis=0), "offset": g.sum(axis=0)}
            g = g * layer["scale"]
            along = (g * normed).mean(axis=1, keepdims=True)
            g = (g - g.mean(axis=1, keepdims=True) - normed * along) / root
        found.insert(0, {"kernel": x.T @ g, "bias": g.sum(axis=0), **here})
        g = g @ layer["kernel"].T
        if i == joins:
            g, action_gradient = g[:, : g.shape[1] - actions], g[:, g.shape[1] - actions :]
    return found, action_gradient


class Reference:
    """TD3 with hand-written derivatives, in float64; a critic is a list of layers."""

    def __init__(self, algorithm: TD3, state: State) -> None:
        self.hyper = algorithm.hyper
        self.joins = getattr(self.hyper, "action_layer", 0)
        self.actor, self.target_actor = plain(state.actor), plain(state.target_actor)
        count = algorithm.hyper.critics
        self.critics = [plain(member(state.critic, i)) for i in range(count)]
        self.targets = [plain(member(state.target_critic, i)) for i in range(count)]
        self.actor_adam = Adam(self.actor, self.hyper.actor_learning_rate)
        rate, decay = self.hyper.critic_learning_rate, getattr(self.hyper, "critic_decay", 0.0)
        self.critic_adams = [Adam(critic, rate, decay) for critic in self.critics]

    def update(self, batch: Batch, noise: list[Any]) -> None:
        """One cycle on (U, B, ...) with the given unclipped smoothing noise of each update."""
        b = Batch(*(None if x is None else np.asarray(x, np.float64) for x in batch))
        for u in range(len(b.reward)):
            limit = self.hyper.target_noise_clip
            following = np.tanh(forward(self.target_actor, b.next_observation[u], None, 0)[0])
            following = np.clip(following + np.clip(noise[u], -limit, limit), -1, 1)
            values = [self._value(t, b.next_observation[u], following)[0] for t in self.targets]
            y = b.reward[u] + b.discount[u] * np.min(values, axis=0)
            for critic, adam in zip(self.critics, self.critic_adams, strict=True):
                value, tape = self._value(critic, b.observation[u], b.action[u])
                slope = 2 * b.weight[u] * (value - y) / len(y)
                adam.step(backward(critic, tape, slope[:, None], self.joins, SPEC.action_size)[0])
        self._move_actor(b.observation[-1])
        self._soften(self.actor, self.target_actor)
        for critic, target in zip(self.critics, self.targets, strict=True):
            self._soften(critic, target)

    def _value(self, critic: Nets, observation: Any, action: Any) -> tuple[Any, list[Any]]:
        value, tape = forward(critic, observation, action, self.joins)
        return value[:, 0], tape

    def _move_actor(self, observation: Any) -> None:
        raw, tape = forward(self.actor, observation, None, 0)
        action = np.tanh(raw)
        value, critic_tape = self._value(self.critics[0], observation, action)
        up = np.full((len(value), 1), -1 / len(value))
        _, slope = backward(self.critics[0], critic_tape, up, self.joins, SPEC.action_size)
        self.actor_adam.step(backward(self.actor, tape, slope * (1 - action**2), -1, 0)[0])

    def _soften(self, network: Nets, target: Nets) -> None:
        for new, old in zip(network, target, strict=True):
            for name in old:
                old[name] = (1 - self.hyper.tau) * old[name] + self.hyper.tau * new[name]

    def parts(self) -> dict[str, list[Nets]]:
        return {
            "actor": [self.actor],
            "target_actor": [self.target_actor],
            "critic": self.critics,
            "target_critic": self.targets,
        }


def plain(network: Any) -> Nets:
    return [{k: np.array(v, np.float64) for k, v in layer.items()} for layer in network]


def smoothing_noise(algorithm: TD3, batch: Batch, key: Any) -> list[Any]:
    """The unclipped noise that `update` draws with this key."""
    *keys, _ = jax.random.split(key, algorithm.updates_per_call + 1)
    draws = [jax.random.normal(k, batch.action.shape[1:], batch.action.dtype) for k in keys]
    return [algorithm.hyper.target_noise * np.asarray(draw, np.float64) for draw in draws]


NORM = {"critic_layer_norm": True, "actor_layer_norm": True}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "td3": ("td3", {}),
    "three-critics": ("td3", {"policy_delay": 3, "critics": 3, "target_noise": 0.0}),
    "layer-norm": ("td3", NORM),
    "ddpg": ("ddpg", {}),
    "ddpg-original": ("ddpg", {**ORIGINAL, "tau": 1e-3}),
}


def cycles_agree(case: str, dtype: Any, make: Minibatches, rtol: float, atol: float) -> None:
    """After each of three cycles every parameter equals the reference's."""
    name, hyper = CASES[case]
    algorithm = learner(name, actor_learning_rate=1e-3, critic_learning_rate=2e-3, **hyper)

    def cast(x: Any) -> Any:
        return x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x

    state = jax.tree.map(cast, fresh(algorithm))
    reference = Reference(algorithm, state)
    for cycle in range(3):
        batch, key = jax.tree.map(cast, make(algorithm.updates_per_call, 16)), jax.random.key(cycle)
        state = update(algorithm, state, batch, key).state
        reference.update(batch, smoothing_noise(algorithm, batch, key))
        for part, networks in reference.parts().items():
            found = getattr(state, part)
            assert {x.dtype for x in jax.tree.leaves(found)} == {np.dtype(dtype)}
            mine = [member(found, i) for i in range(len(networks))] if "critic" in part else [found]
            for network, expected in zip(mine, networks, strict=True):
                close = partial(
                    np.testing.assert_allclose, rtol=rtol, atol=atol, err_msg=f"{part} {cycle}"
                )
                jax.tree.map(close, list(network), expected)


@pytest.mark.parametrize("case", CASES)
def test_cycles_equal_a_reference_in_numpy(case: str, minibatches: Minibatches) -> None:
    """In float64, where only the arithmetic can differ, three cycles agree to 1e-9."""
    with jax.enable_x64(True):
        cycles_agree(case, np.float64, minibatches, rtol=1e-9, atol=1e-12)


def test_cycles_in_float32_equal_the_reference(minibatches: Minibatches) -> None:
    """As training runs it, to 1e-5 of each number (and of steps of 1e-3 near zero)."""
    cycles_agree("td3", np.float32, minibatches, rtol=1e-5, atol=1e-7)


# DDPG.


def test_ddpg_is_td3_without_its_tricks(minibatches: Minibatches) -> None:
    """One critic, no delay, no smoothing: the same bits after five cycles."""
    ours, theirs = learner("td3", critics=1, policy_delay=1, target_noise=0), learner("ddpg")
    a, b = fresh(ours), fresh(theirs)
    for cycle in range(5):
        batch, key = minibatches(1, 16), jax.random.key(cycle)
        a, b = update(ours, a, batch, key), update(theirs, b, batch, key)
        assert same(*map(jax.tree.leaves, (a, b)))  # DDPG's Adam stands in a chain, for its decay
        a, b = a.state, b.state


def test_original_ddpg_is_as_published() -> None:
    """Its preset: sizes, rates, decay, noise and where the action joins."""
    hyper = resolve("ddpg-original", "Walker2d-v5").hyper
    assert (hyper.hidden, hyper.batch_size, hyper.tau) == ((400, 300), 64, 1e-3)
    assert (hyper.actor_learning_rate, hyper.critic_learning_rate) == (1e-4, 1e-3)
    assert (hyper.critic_decay, hyper.action_layer, hyper.output_bound) == (1e-2, 1, 3e-3)
    assert (hyper.exploration, hyper.exploration_noise) == ("ou", 0.2)
    state = jax.eval_shape(algorithms.find("ddpg").build(SPEC, hyper).init, KEY)
    shapes = [layer["kernel"].shape for layer in state.critic]
    assert shapes == [(1, 3, 400), (1, 402, 300), (1, 300, 1)]


def test_late_action_enters_through_layer_2_alone(minibatches: Minibatches) -> None:
    """Without the action's rows of layer 2 the value no longer knows the action."""
    algorithm, batch = learner("ddpg", action_layer=1), minibatches(16)
    first, second, last = fresh(algorithm).critic

    def value(critic: Any, sign: float) -> Any:
        return values(algorithm, critic, batch.observation, np.float32(sign) * batch.action)

    assert np.all(value((first, second, last), 1) != value((first, second, last), -1))
    second["kernel"][:, -SPEC.action_size :] = 0
    deaf = (first, second, last)
    np.testing.assert_array_equal(value(deaf, 1), value(deaf, -1))


# Exploration.


def noise_of(kind: str, scale: float, steps: int, size: int) -> Any:
    """A long episode's actions (steps, size) of an actor whose clean action is 0."""
    algorithm = learner(spec=Spec(3, size), exploration=kind, exploration_noise=scale)
    rng, observation = np.random.default_rng(1), np.zeros(3, np.float32)
    params = constant(fresh(algorithm).actor, 0), ()
    noise_state = algorithm.start_episode(params, rng)
    actions: list[Any] = []
    for _ in range(steps):
        action, noise_state = algorithm.act(params, noise_state, observation, rng)
        actions.append(action)
    return np.array(actions)


def test_ou_noise_has_its_stationary_statistics() -> None:
    """Pull .15: variance sigma^2 / (1 - .85^2), correlation .85 a step; 5 standard errors."""
    noise = noise_of("ou", scale=0.2, steps=10_000, size=16)[100:]
    variance = 0.2**2 / (1 - 0.85**2)
    samples = noise.size * (1 - 0.85**2) / (1 + 0.85**2)  # independent ones
    assert abs(noise.var() / variance - 1) < 5 * (2 / samples) ** 0.5
    assert abs(noise.mean()) < 5 * (variance * (1 + 0.85) / (1 - 0.85) / noise.size) ** 0.5
    correlation = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert abs(correlation - 0.85) < 5 * ((1 - 0.85**2) / noise.size) ** 0.5
    across = np.corrcoef(noise.T)[~np.eye(16, dtype=bool)]
    assert np.abs(across).max() < 5 * (16 / samples) ** 0.5


def test_ou_noise_starts_at_rest() -> None:
    """The first action's deviation is sigma itself: nothing is remembered yet."""
    first = noise_of("ou", scale=0.2, steps=1, size=10_000)
    assert abs(first.std() - 0.2) < 5 * 0.2 / 20_000**0.5


def test_gaussian_noise_remembers_nothing() -> None:
    """Its deviation is the setting's, and one step tells nothing of the next."""
    noise = noise_of("gaussian", scale=0.1, steps=5_000, size=8)
    assert abs(noise.std() / 0.1 - 1) < 5 / 80_000**0.5
    correlation = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert abs(correlation) < 5 / 40_000**0.5


def test_ou_memory_is_reset_where_an_episode_starts(runs: Path) -> None:
    """A member whose episode begins acts from an empty memory; the others keep theirs."""
    settings = {**TINY, "warmup": 0, "steps": 100, "members": 2, "rule": "none", "wait": False}
    trainer = Trainer(
        "ddpg",
        "probe_envs:Scripted-v0",
        runs=runs,
        **settings,
        exploration="ou",
        updates_per_step=1e-9,
    )
    loop = trainer.loop
    loop.explorers[0].env.env.unwrapped.length = 4
    step, seen = loop._step, []

    def watched(k: int) -> None:
        seen.append((not loop.explorers[k].env.actions, np.copy(loop.explorers[k].noise_state)))
        step(k)

    loop._step = watched
    run_to_end(trainer)
    assert len(seen) == 100
    assert sum(start for start, _ in seen) == 18  # 50 / 4 and 50 / 10, rounded up
    for start, memory in seen:
        assert np.all(memory == 0) == start


def test_layer_norm_and_its_gradient_are_those_of_jax(rng: np.random.Generator) -> None:
    """Against what JAX derives of its own form; a row of equal numbers becomes zeros."""
    rows, weights = rng.normal(size=(2, 3, 7, 9), loc=2)
    rows[:, 0] = 5
    with jax.enable_x64(True):
        found, pull = jax.vjp(mlp.standardize, rows)
        expected, pull_expected = jax.vjp(partial(jax.nn.standardize, epsilon=1e-5), rows)
        (gradient,), (gradient_expected,) = pull(weights), pull_expected(weights)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(gradient[:, 1:], gradient_expected[:, 1:], rtol=1e-11, atol=1e-11)
    assert np.all(np.asarray(found)[:, 0] == 0)
    flat = weights[:, 0] - weights[:, 0].mean(axis=-1, keepdims=True)
    np.testing.assert_allclose(gradient[:, 0], flat / np.sqrt(1e-5), rtol=1e-12)


# What leaves training, and JAX's own checks.


@pytest.mark.parametrize("norm", [False, True])
def test_policy_file_acts_as_the_learner(
    norm: bool, tmp_path: Path, rng: np.random.Generator
) -> None:
    """JAX, the NumPy that acts in training and a saved and loaded file agree to 1e-6."""
    algorithm = learner(hidden=(32, 24), actor_layer_norm=norm, exploration_noise=0.0)
    state = jax.tree.map(lambda x: np.asarray(0.4 * x, x.dtype), fresh(algorithm))
    mean = np.array([3, -2, 0], np.float32)
    deviation = np.array([2, 3, 0.3], np.float32)  # by which the last one is often cut at +-10
    low, high = np.array([-0.4, 0], np.float32), np.array([0.4, 5], np.float32)
    actors = algorithm.policy(state)
    layers = unstack(actors.layers)
    policy = Policy(layers, actors.activation, actors.output, low, high, (mean, deviation))
    policy.save(tmp_path / "policy.safetensors")
    loaded = load(tmp_path / "policy.safetensors")
    observations = rng.normal(size=(50, 3), scale=3).astype(np.float32)
    scaled = np.clip((observations - mean) / deviation, -10, 10)
    expected = np.asarray(jax.jit(mlp.actor)(state.actor, scaled))
    assert np.all(expected.std(axis=0) > 0.01)
    assert 0.1 < np.mean(np.abs(scaled[:, 2]) == 10) < 0.9
    np.testing.assert_allclose(loaded.act(observations), expected, rtol=0, atol=1e-6)
    in_env = low + (high - low) * (expected + 1) / 2
    np.testing.assert_allclose(loaded(observations), in_env, rtol=0, atol=5e-6)
    params = jax.device_get(algorithm.policy_params(state))
    for x, action in zip(scaled, expected, strict=True):
        found, _ = algorithm.act(params, (), x, rng)
        np.testing.assert_allclose(found, action, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["td3", "ddpg"])
def test_a_learner_uses_no_key_twice(name: str, minibatches: Minibatches) -> None:
    """JAX's check of key reuse passes whatever it traces, and would refuse a reused one."""
    algorithm = learner(name)
    state, batch = fresh(algorithm), minibatches(algorithm.updates_per_call, 16)

    def reuse(key: Any) -> Any:
        return algorithm.update(state, batch, key), jax.random.normal(key, (2,))

    with jax.debug_key_reuse(True):
        jax.eval_shape(jax.jit(algorithm.init), KEY)
        jax.eval_shape(jax.jit(algorithm.update), state, batch, KEY)
        with pytest.raises(jax.errors.KeyReuseError):
            jax.eval_shape(jax.jit(reuse), KEY)


@pytest.mark.parametrize(
    ("name", "settings"),
    [("multi-td3", {}), ("ddpg", {"exploration": "ou", "members": 2, "rule": "none"})],
)
def test_nothing_is_nan(name: str, settings: dict[str, Any], runs: Path, nans_raise: None) -> None:
    """A short run, from an empty replay through selections, under JAX's check of NaN."""
    settings = {**TINY, "warmup": 20, "steps": 80, **settings}
    trainer = Trainer(name, "probe_envs:Scripted-v0", runs=runs, **settings)
    assert run_to_end(trainer).rows()[-1]["step"] == 80
    assert all(state.updates >= 20 for state in trainer.loop.learners.states)


@pytest.mark.parametrize(("also", "updates"), [(False, 50), (True, 100)])
def test_the_warmup_can_be_learned_from_as_it_goes(also: bool, updates: int, runs: Path) -> None:
    """With `warmup_updates` every step has its update; the first 50 actions are random still."""
    settings = {**TINY, "warmup": 50, "steps": 100, "warmup_updates": also}
    trainer = Trainer("td3", "probe_envs:Scripted-v0", runs=runs, **settings)
    assert run_to_end(trainer).rows()[-1]["updates"] == updates
    assert trainer.loop.learners.states[0].updates == updates
    assert trainer.progress.members[0].actions == 50


# Learning a walker's task; in so few steps HalfCheetah is not learned with every seed.


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_short_run_beats_uniform_actions(seed: int, runs: Path) -> None:
    """8,000 steps: the worst of ten episodes stands four times as long as the best of theirs."""
    env = "InvertedPendulum-v5"
    settings: dict[str, Any] = {"steps": 8_000, "warmup": 1_000, "eval_episodes": 1, "seed": seed}
    trainer = Trainer("td3", env, runs=runs, **settings)
    run_to_end(trainer)
    ours, theirs = (evaluate(policy, env).returns for policy in (trainer.policy(), None))
    assert min(ours) > 4 * max(theirs)

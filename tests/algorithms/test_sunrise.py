"""SUNRISE: golden weights and bounds, its base learner as a special case, masks, blocks, files."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import learner as any_learner
from numeric import KEY, SPEC, double, member, random_batch, single
from short_runs import TINY, run_to_end

from pacesetter.algorithms import sunrise
from pacesetter.batch import Batch, Spec
from pacesetter.config import resolve
from pacesetter.ensemble import members
from pacesetter.errors import UsageError
from pacesetter.networks import mlp
from pacesetter.networks.forward import forward
from pacesetter.policy import Policy, load, unstack
from pacesetter.training.trainer import Trainer

BASES = {"sunrise": "sac", "sunrise-td3": "td3"}
both = pytest.mark.parametrize("name", BASES)
forms = pytest.mark.parametrize("reference", ["paper", "official"])
pairs = pytest.mark.parametrize(
    ("name", "reference"),
    [
        ("sunrise", "paper"),
        ("sunrise-td3", "official"),
        pytest.param("sunrise", "official", marks=pytest.mark.slow),
        pytest.param("sunrise-td3", "paper", marks=pytest.mark.slow),
    ],
)
_jit = partial(jax.jit, static_argnums=0)
init = _jit(lambda learner, key: learner.init(key))
update = _jit(lambda learner, *arguments: learner.update(*arguments))
target = _jit(lambda learner, *arguments: learner.target(*arguments))
next_action = _jit(lambda learner, *arguments: learner.next_action(*arguments))


def learner(name: str, spec: Spec = SPEC, **hyper: Any) -> Any:
    return any_learner(name, spec, **{"hidden": (8,), **hyper})


def begin(algorithm: Any, key: Any = KEY) -> Any:
    """A state whose targets are unlike its networks."""
    state, other = init(algorithm, key), init(algorithm, jax.random.key(99))
    names = [name for name in ("target_actor", "target_critic") if hasattr(state, name)]
    return state._replace(**{name: getattr(other, name) for name in names})


def minibatches(cycle: int, rows: int, mask: Any, seed: int = 0) -> Batch:
    """Random transitions (cycle, rows), all with the same masks (rows, N)."""
    batch = single(random_batch(np.random.default_rng(seed), SPEC, cycle, rows))
    mask = np.broadcast_to(np.float32(mask), (cycle, rows, np.shape(mask)[-1]))
    return batch._replace(mask=mask)


def leaves(tree: Any) -> list[Any]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


# Its base learner is the ensemble of one.


@both
def test_an_ensemble_of_one_is_its_base(name: str) -> None:
    """N=1, beta=1, T=0: in float64, after three cycles, all of the state is the base's."""
    ours = learner(name, ensemble=1, mask_probability=1, backup_temperature=0)
    base = learner(BASES[name])
    with jax.enable_x64(True):
        state = double(begin(ours))
        alone = member(state, 0)
        for cycle in range(3):
            key = jax.random.key(cycle)
            batch = double(minibatches(base.updates_per_call, 16, np.ones((16, 1)), seed=cycle))
            found = update(ours, state, batch, key)
            expected = update(base, alone, batch, key)
            state, alone = found.state, expected.state
            for one, other in zip(leaves(state), leaves(alone), strict=True):
                np.testing.assert_allclose(one[0], other, rtol=1e-11, atol=1e-14)
            np.testing.assert_allclose(found.td_error, expected.td_error, rtol=1e-11)
            for loss, value in expected.losses.items():
                np.testing.assert_allclose(found.losses[loss], value, rtol=1e-11)
    assert np.all(leaves(state.updates)[0] == 3 * base.updates_per_call)


@both
def test_learners_of_an_ensemble_begin_as_its_base(name: str) -> None:
    """Learner i is what the base makes of its key; no two are alike."""
    state = init(learner(name, ensemble=3), KEY)
    for i, key in enumerate(jax.random.split(KEY, 3)):
        alone = init(learner(BASES[name]), key)
        for one, other in zip(leaves(member(state, i)), leaves(alone), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6)
    kernels = np.asarray(state.critic[0]["kernel"])
    assert len({kernel.tobytes() for twins in kernels for kernel in twins}) == 6


@both
def test_official_gradients_are_a_row_short(name: str) -> None:
    """Losses are divided by the rows plus 1: 256 / 257 of the base's, for whatever is fitted."""
    still = {"critic_learning_rate": 1e-300}  # so that actors climb the same critics
    official = {"reference": "official", "ensemble": 1, "backup_temperature": 0}
    ours, base = learner(name, **official, **still), learner(BASES[name], **still)
    with jax.enable_x64(True):
        state = double(begin(ours))
        batch = double(minibatches(1, 256, np.ones((256, 1))))
        batch = jax.tree.map(lambda x: np.repeat(x, base.updates_per_call, axis=0), batch)
        found = update(ours, state, batch, KEY).state
        alone = update(base, member(state, 0), batch, KEY).state
        moments = [field for field in found._fields if field.endswith("_opt_state")]
        assert len(moments) == (3 if name == "sunrise" else 2)
        for field in moments:
            pairs = zip(firsts(getattr(found, field)), firsts(getattr(alone, field)), strict=True)
            for one, other in pairs:
                assert np.any(other != 0)
                np.testing.assert_allclose(one[0], other * 256 / 257, rtol=1e-9, atol=1e-18)


def firsts(optimizer: Any) -> list[Any]:
    """First moments of every Adam in an optimiser."""
    states = jax.tree.leaves(optimizer, is_leaf=lambda x: hasattr(x, "mu"))
    return [leaf for state in states if hasattr(state, "mu") for leaf in leaves(state.mu)]


# Masks.


@pairs
def test_a_learner_without_rows_stands_still(name: str, reference: Any) -> None:
    """Its gradients are exactly 0, of critics, actor and temperature; nothing is NaN."""
    ours = learner(name, ensemble=3, reference=reference)
    state = begin(ours)
    batch = minibatches(ours.updates_per_call, 16, np.tile([1, 0, 1], (16, 1)))
    new = update(ours, state, batch, KEY).state
    assert all(np.isfinite(leaf).all() for leaf in leaves(new))
    for field in (field for field in new._fields if field.endswith("_opt_state")):
        for moment in firsts(getattr(new, field)):
            assert np.all(moment[1] == 0)
            assert np.any(moment[0] != 0)
            assert np.any(moment[2] != 0)
    for part in ("actor", "critic", *(["log_alpha"] if name == "sunrise" else [])):
        for old, moved in zip(
            leaves(getattr(state, part)), leaves(getattr(new, part)), strict=True
        ):
            np.testing.assert_array_equal(old[1], moved[1])
            assert np.any(old[0] != moved[0])


@pairs
def test_masked_rows_mean_nothing(name: str, reference: Any) -> None:
    """What a masked row holds changes no bit of that learner, and all of the other one."""
    ours = learner(name, ensemble=2, reference=reference)
    mask = np.ones((16, 2))
    mask[5:9, 0] = 0
    batch = minibatches(ours.updates_per_call, 16, mask)
    other = jax.tree.map(np.copy, batch)
    other.reward[:, 5:9] += 3
    other.action[:, 5:9] *= -1
    one, two = (update(ours, begin(ours), rows, KEY).state for rows in (batch, other))
    moments = [firsts(state.critic_opt_state) for state in (one, two)]
    for a, b in zip(*moments, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
        assert np.any(a[1] != b[1])


@forms
def test_a_masked_mean_is_over_the_rows_that_count(reference: Any) -> None:
    """Weights (N, B) turn a mean over B into one over a learner's rows, or one row more."""
    ours = learner("sunrise", ensemble=3, reference=reference)
    mask = np.array([[1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 1, 0]], np.float32)
    surplus = int(reference == "official")
    expected = [[4 / (4 + surplus)] * 4, [0, 4 / (2 + surplus), 0, 4 / (2 + surplus)], [0] * 4]
    np.testing.assert_allclose(ours.share(mask), expected, rtol=1e-6)


@pytest.mark.slow
def test_every_row_is_somebodys(rng: np.random.Generator) -> None:
    """Raw draws leave 1 row of 32 to nobody; with the repair none, and the rate is .50625."""
    ours = learner("sunrise")
    masks = np.array([ours.mask(rng) for _ in range(1_000_000)])
    assert masks.dtype == np.float32
    assert set(np.unique(masks)) == {0, 1}
    assert masks.sum(axis=1).min() == 1
    error = (0.50625 * 0.49375 / len(masks)) ** 0.5
    np.testing.assert_allclose(masks.mean(axis=0), 0.50625, atol=3 * error)
    singles = (masks.sum(axis=1) == 1).mean()  # 5 of 32 drawn, 1 of 32 repaired
    assert abs(singles - 6 / 32) < 3 * (6 / 32 * 26 / 32 / len(masks)) ** 0.5
    assert learner("sunrise", ensemble=4, mask_probability=1).mask(rng).tolist() == [1] * 4


# Weighted backups.


def test_weights_of_backups() -> None:
    """Golden values; 1 without deviation or with T=0; falling towards a half."""
    for temperature, deviation, expected in (
        (20, 0, 1),
        (20, 0.1, 0.619203),
        (10, 0.05, 0.877541),
        (50, 0.2, 0.500045),
        (0, 7, 1),
    ):
        found = sunrise.backup_weight(jnp.float32(deviation), temperature)
        np.testing.assert_allclose(found, expected, atol=1e-6)
    weights = np.asarray(sunrise.backup_weight(jnp.linspace(0, 0.7, 100), 20.0))
    assert np.all(np.diff(weights) < 0)
    assert np.all((weights > 0.5) & (weights <= 1))


def value(network: Any, observation: Any, action: Any) -> Any:
    """One critic in NumPy."""
    layers = [{name: np.asarray(x) for name, x in layer.items()} for layer in network]
    return forward(layers, np.concatenate([observation, action], axis=-1))[..., 0]


@pairs
def test_target_and_deviation_by_loops(name: str, reference: Any) -> None:
    """y of each learner from its own action and critics; deviation as the form has it."""
    size, rows = 3, 7
    ours = learner(name, ensemble=size, reference=reference)
    state, batch = begin(ours), member(minibatches(1, rows, np.ones((rows, size))), 0)
    keys = jax.random.split(KEY, size)
    y, deviation = target(ours, state, batch, keys)
    following = batch.next_observation
    own = []
    for i in range(size):
        action, bonus = next_action(ours, member(state, i), following, keys[i])
        own.append((np.asarray(action), np.asarray(bonus)))
    critics = [[member(member(state.target_critic, k), j) for j in range(2)] for k in range(size)]
    for i, (action, bonus) in enumerate(own):
        twins = [value(critic, following, action) for critic in critics[i]]
        expected = batch.reward + batch.discount * (np.min(twins, axis=0) + bonus)
        np.testing.assert_allclose(y[i], expected, atol=1e-5)
        if reference == "paper":
            least = [
                np.min([value(c, following, action) for c in pair], axis=0) for pair in critics
            ]
            np.testing.assert_allclose(deviation[i], np.std(least, axis=0), atol=1e-6)
    if reference == "official":
        all_values = [value(c, following, own[k][0]) for k in range(size) for c in critics[k]]
        np.testing.assert_allclose(deviation, np.std(all_values, axis=0), atol=1e-6)
    assert np.all(np.asarray(deviation) > 1e-3)


@both
def test_a_weight_scales_the_gradient_of_its_row(name: str) -> None:
    """With one row, T weighs the whole gradient: Adam's moments are the weight times T=0's."""
    rows = {"ensemble": 2, "policy_delay": 1} if name == "sunrise-td3" else {"ensemble": 2}
    warm, cold = learner(name, **rows, backup_temperature=0), learner(name, **rows)
    state, batch = begin(warm), minibatches(1, 1, np.ones((1, 2)))
    plain, weighed = (update(one, state, batch, KEY) for one in (warm, cold))
    keys = jax.random.split(KEY, (2, 2))
    _, deviation = target(cold, state, member(batch, 0), keys[0])
    weight = np.asarray(sunrise.backup_weight(deviation, 20.0))[:, 0]
    assert np.all(weight < 0.999)
    pairs = zip(
        firsts(weighed.state.critic_opt_state), firsts(plain.state.critic_opt_state), strict=True
    )
    for one, other in pairs:
        shape = (2,) + (1,) * (other.ndim - 1)
        np.testing.assert_allclose(one, weight.reshape(shape) * other, rtol=2e-4, atol=1e-7)
    np.testing.assert_allclose(weighed.losses["backup_weight"], weight.mean(), rtol=1e-5)


@forms
def test_no_gradient_flows_through_target_and_weight(reference: Any) -> None:
    ours = learner("sunrise", ensemble=2, reference=reference)
    state, batch = begin(ours), member(minibatches(1, 8, np.ones((8, 2))), 0)
    keys = jax.random.split(KEY, 2)

    def total(actor: Any, critic: Any) -> Any:
        changed = state._replace(actor=actor, target_critic=critic)
        y, deviation = ours.target(changed, batch, keys)
        return y.sum() + sunrise.backup_weight(deviation, 20.0).sum()

    slopes = jax.jit(jax.grad(total, (0, 1)))(state.actor, state.target_critic)
    assert not any(np.any(leaf) for leaf in leaves(slopes))


def test_histogram_of_weights() -> None:
    """Shares by tenths, the last with its upper end; they sum to 1."""
    weight = jnp.array([0.5, 0.55, 0.61, 0.95, 1.0])
    found = sunrise.backup_losses(jnp.full(5, 2.0), weight)
    shares = [float(found[f"backup_weight_0.{i}"]) for i in range(5, 10)]
    np.testing.assert_allclose(shares, [0.4, 0.2, 0, 0, 0.4], atol=1e-6)
    assert found["value_deviation"] == 2


# Acting.


def straight_critics(slopes: Any) -> Any:
    """Critics (N, 2) in the layout of acting: Q = 1 + slope * a for a >= 0."""
    slopes = np.float32(slopes)
    shape = slopes.shape
    first = {"kernel": np.zeros((*shape, 2, 1), np.float32), "bias": np.zeros((*shape, 1, 1))}
    first["kernel"][..., 1, 0] = 1
    last = {"kernel": slopes[..., None, None], "bias": np.ones((*shape, 1, 1), np.float32)}
    return (first, last)


def test_bound_that_is_chosen() -> None:
    """Estimates (1, 1, 1, 1) and (0, 2, 0, 1.5): the second is better from lambda = .140028."""
    critics = straight_critics([[-1, 1], [-1, 0.5]])
    actions = np.array([[0], [1]], np.float32)
    for weight, best in ((0, 0), (0.14002, 0), (0.14003, 1), (5, 1)):
        ours = learner("sunrise", Spec(1, 1), ensemble=2, reference="official", ucb=weight)
        bounds = ours.upper_bounds(critics, np.zeros(1, np.float32), actions)
        np.testing.assert_allclose(bounds, [1, 0.875 + weight * 0.892679], atol=1e-5)
        assert np.argmax(bounds) == best
    paper = learner("sunrise", Spec(1, 1), ensemble=2, ucb=2)  # the minimum of each pair
    bounds = paper.upper_bounds(
        straight_critics([[-1, 1], [-0.5, 3]]), np.zeros(1, np.float32), actions
    )
    np.testing.assert_allclose(bounds, [1, 0.25 + 2 * 0.25], atol=1e-6)


def proposals(name: str, ours: Any, state: Any, observation: Any, rng: Any) -> list[Any]:
    """What each learner would do, one after the other."""
    noise = rng.standard_normal((ours.hyper.ensemble, 1, 2), np.float32)[:, 0]
    found = []
    for i, draw in enumerate(noise):
        layers = [{k: np.asarray(x[i]) for k, x in layer.items()} for layer in state.actor]
        said = forward(layers, observation)
        if name == "sunrise":
            mean, log_std = said[:2], said[2:]
            found.append(np.tanh(mean + np.exp(np.clip(log_std, -20, 2)) * draw))
        else:
            found.append(np.clip(np.tanh(said) + 0.4 * draw, -1, 1))
    return found


@pairs
def test_the_best_bound_by_loops(name: str, reference: Any, rng: np.random.Generator) -> None:
    """Each proposal is asked about one by one; the best is done, and it is not always one's."""
    size = 4
    noise = {"exploration_noise": 0.4} if name == "sunrise-td3" else {}
    ours = learner(name, ensemble=size, reference=reference, ucb=2.0, **noise)
    state = begin(ours)
    params = jax.device_get(ours.policy_params(state))
    noise_state = ours.start_episode(params, rng)
    winners = set()
    for step in range(30):
        observation = rng.normal(size=3).astype(np.float32)
        draws = np.random.default_rng(step)
        mine = proposals(name, ours, state, observation, np.random.default_rng(step))
        bounds = []
        for action in mine:
            pairs = [
                [
                    float(value(member(member(state.critic, k), j), observation, action))
                    for j in (0, 1)
                ]
                for k in range(size)
            ]
            judged = np.min(pairs, axis=1) if reference == "paper" else np.ravel(pairs)
            bounds.append(np.mean(judged) + 2 * np.std(judged))
        action, noise_state = ours.act(params, noise_state, observation, draws)
        best = int(np.argmax(bounds))
        winners.add(best)
        assert action.shape == (2,)
        np.testing.assert_allclose(action, mine[best], atol=1e-5)
    assert len(winners) > 1


@both
def test_official_without_lambda_follows_one_learner(name: str, rng: np.random.Generator) -> None:
    """One learner, drawn uniformly, for a whole episode; its critics are not even asked."""
    noise = {"exploration_noise": 0.4} if name == "sunrise-td3" else {}
    ours = learner(name, ensemble=3, reference="official", ucb=0, **noise)
    state = begin(ours)
    params = jax.device_get(ours.policy_params(state))
    assert not params.critic
    chosen = []
    for episode in range(300):
        noise_state = ours.start_episode(params, rng)
        chosen.append(int(noise_state[1]))
        for step in range(2 if episode < 5 else 0):
            observation = rng.normal(size=3).astype(np.float32)
            mine = proposals(name, ours, state, observation, np.random.default_rng(step))
            action, noise_state = ours.act(
                params, noise_state, observation, np.random.default_rng(step)
            )
            np.testing.assert_allclose(action, mine[chosen[-1]], atol=1e-6)
            assert int(noise_state[1]) == chosen[-1]
    assert np.bincount(chosen).min() > 100 - 4 * (300 * 2 / 9) ** 0.5
    assert not learner(name, ucb=0).follows_one  # the paper's is greedy then


@both
def test_policy_file_averages_actions(name: str, tmp_path: Path, rng: Any) -> None:
    """The mean of N actions after tanh, from a file and NumPy alone."""
    ours = learner(name, ensemble=3)
    state = jax.tree.map(lambda x: 2 * x, begin(ours))
    actors = ours.policy(state)
    low, high = np.full(2, -1, np.float32), np.full(2, 1, np.float32)
    layers = unstack(actors.layers)
    policy = Policy(layers, actors.activation, actors.output, low, high)
    policy.save(tmp_path / "policy.safetensors")
    observation = rng.normal(size=(20, 3)).astype(np.float32)
    each = [np.tanh(mlp.apply(member(state.actor, i), observation)[:, :2]) for i in range(3)]
    assert np.ptp(each, axis=0).max() > 0.1
    found = load(tmp_path / "policy.safetensors")
    assert len(found.actors) == 3
    np.testing.assert_allclose(found.act(observation), np.mean(each, axis=0), atol=1e-6)


# In a run.


@pytest.mark.parametrize("name", ["sunrise", "multi-sunrise-td3"])
def test_ledger_and_log_of_a_run(name: str, runs: Path) -> None:
    """Ensemble updates, passes of the bounds, stored masks and the histogram."""
    settings = {**TINY, "hidden": (8,), "steps": 300, "ensemble": 3}
    trainer = Trainer(name, "probe_envs:Scripted-v0", runs=runs, **settings)
    layout, path = trainer.loop.learners.compiled.layout, trainer.loop.replays[0].path
    last = run_to_end(trainer).rows()[-1]
    assert last["updates"] in (199, 200, 198)
    assert last["ensemble_updates"] == 3 * last["updates"]
    assert last["ucb_passes"] == 200 * (3 + 3 * 3 * 2)
    rows = np.fromfile(path, np.float32).reshape(-1, layout.width)[:300]
    masks = rows[:, -3:]
    assert set(np.unique(masks)) == {0, 1}
    assert masks.sum(axis=1).min() == 1
    logged = [row for row in trainer.directory.rows() if "value_deviation" in row][-1]
    shares = [logged[f"backup_weight_0.{i}"] for i in range(5, 10)]
    assert sum(shares) == pytest.approx(1)
    assert 0.5 <= logged["backup_weight"] <= 1
    assert len(load(trainer.directory.policy_file).actors) == 3


def test_official_updates_come_in_blocks(runs: Path) -> None:
    """Nothing is learned between two blocks, and all that is due at a block's end."""
    settings = {
        **TINY,
        "hidden": (8,),
        "steps": 120,
        "warmup": 10,
        "ensemble": 2,
        "update_every": 40,
    }
    trainer = Trainer("sunrise", "probe_envs:Scripted-v0", runs=runs, **settings)
    seen: list[int] = []
    tick = trainer.loop.tick

    def watched() -> Any:
        found = tick()
        seen.append(trainer.progress.updates)
        return found

    trainer.loop.tick = watched
    run_to_end(trainer)
    assert seen == [0] * 39 + [30] * 40 + [70] * 40 + [110]


def test_blocks_longer_than_a_tick_are_made_whole(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The env waits until all due updates are made; where the ticks end changes nothing."""
    small = {"hidden": (8,), "steps": 120, "warmup": 10, "ensemble": 2, "update_every": 40}
    states: list[Any] = []
    for name, longest in (("whole", 500), ("parts", 7)):
        monkeypatch.setattr(members, "MAX_CALLS_PER_TICK", longest)
        trainer = Trainer(
            "sunrise", "probe_envs:Scripted-v0", runs=runs, name=name, **{**TINY, **small}
        )
        run_to_end(trainer)
        assert trainer.progress.updates == 110
        states.append(jax.device_get(trainer.loop.learners.states))
    pairs = zip(*map(jax.tree.leaves, states), strict=True)
    assert all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("other", [{"update_at": "episode"}, {"assess": 2}])
def test_blocks_and_episode_ends_are_refused_together(other: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="update_every: blocks of 50 steps"):
        resolve("td3", "HalfCheetah-v5", {"update_every": 50, **other})


def test_forms_have_their_blocks() -> None:
    env = "HalfCheetah-v5"
    assert resolve("sunrise", env).hyper.block == 1
    assert resolve("sunrise", env, {"reference": "official"}).hyper.block == 1000
    assert resolve("sunrise", env, {"reference": "official", "update_every": 5}).hyper.block == 5
    assert resolve("td3", env, {"update_every": 50}).hyper.block == 50


@pytest.mark.parametrize("env", ["HalfCheetah-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5"])
def test_presets(env: str) -> None:
    """The official preset knows each of the four tasks."""
    config = resolve("sunrise-official", env)
    hyper = config.hyper
    assert (hyper.reference, hyper.ensemble, hyper.warmup) == ("official", 5, 1000)
    assert (hyper.mask_probability, hyper.backup_temperature, hyper.ucb) == (0.5, 20, 1)
    assert config.run.steps == (1_000_000 if "Humanoid" in env else 211_000)


def test_other_noise_is_refused() -> None:
    """Proposals of TD3 learners have Gaussian noise."""
    with pytest.raises(UsageError, match=r"exploration: .*gaussian"):
        resolve("sunrise-td3", "HalfCheetah-v5", {"exploration": "ou"})


@both
def test_an_ensemble_uses_no_key_twice(name: str) -> None:
    ours = learner(name, ensemble=2)
    batch = minibatches(ours.updates_per_call, 8, np.ones((8, 2)))
    with jax.debug_key_reuse(True):
        state = jax.eval_shape(jax.jit(ours.init), KEY)
        jax.eval_shape(jax.jit(ours.update), state, batch, KEY)


@pairs
def test_nothing_is_nan(name: str, reference: Any, runs: Path, nans_raise: None) -> None:
    """A short run, from an empty replay on, with masks that leave learners without rows."""
    settings = {**TINY, "batch_size": 2, "hidden": (8,), "warmup": 20, "steps": 80}
    settings |= {"ensemble": 3, "mask_probability": 0.1, "update_every": 10}
    settings["reference"] = reference
    trainer = Trainer(name, "probe_envs:Scripted-v0", runs=runs, **settings)
    assert run_to_end(trainer).rows()[-1]["step"] == 80
    assert np.all(trainer.loop.learners.states[0].updates == 60)


@both
def test_settings_of_the_base_keep_their_defaults(name: str) -> None:
    """Such as SAC's warm-up of 10k; only the exploration of TD3's proposals is fixed."""
    ours, base = (resolve(each, "HalfCheetah-v5").hyper for each in (name, BASES[name]))
    for setting in vars(base):
        assert getattr(ours, setting) == getattr(base, setting), setting


@both
def test_a_row_is_as_urgent_as_it_is_to_those_that_train_on_it(name: str) -> None:
    """A learner that is masked out gains nothing from the row, however wrong it is there."""
    ours = learner(name, ensemble=2)
    state = begin(ours)
    wrong = jax.tree.map(lambda x: x.at[0].set(x[0] + 1_000 * (x.ndim == 3)), state.critic)
    state = state._replace(critic=wrong)
    key, batches = jax.random.key(0), []
    for mask in ([0.0, 1.0], [1.0, 1.0]):
        batches.append(minibatches(ours.updates_per_call, 16, np.tile(mask, (16, 1))))
    others, both_learn = (update(ours, state, batch, key).td_error[0] for batch in batches)
    assert np.all(np.asarray(both_learn) > 10 * np.asarray(others))

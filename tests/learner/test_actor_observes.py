"""`--actor-observes`: critics see the whole observation, the actor a part of it alone."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from short_runs import TINY, assert_same, run_to_end
from stopping import stop_at

from pacesetter import Trainer, algorithms, load
from pacesetter.batch import Layout, Spec
from pacesetter.cli.main import main
from pacesetter.config import resolve
from pacesetter.ensemble.averages import Averages
from pacesetter.errors import UsageError
from pacesetter.learner.compiled import CompiledLearner, UpdateInputs, of_transitions
from pacesetter.media.onnx import build
from pacesetter.media.sb3 import SB3Policy
from pacesetter.networks import mlp
from pacesetter.policy import Policy
from pacesetter.settings.values import chosen
from pacesetter.types import Floats

ENV = "Pendulum-v1"  # its observation: cosine, sine, and the speed, which is hidden here
SHORT: dict[str, Any] = {**TINY, "steps": 260, "eval_every": 260, "actor_observes": ":2"}
MODELS = {"model_hidden": (8,), "head_hidden": (8,), "critic_members": 2}
CASES: dict[str, dict[str, Any]] = {
    "td3": {"actor_layer_norm": True, "normalize_observation": True},
    "multi-td3": {"copy": "actor", "steps": 460, "snapshots": 2},
    "ddpg": {},
    "sac": {},
    "tqc": {"critics": 2, "quantiles": 3, "dropped": 1},
    "crossq": {"critic_hidden": (16,), "weight_norm": True, "normalize_observation": True},
    "sunrise": {"ensemble": 3},
    "sunrise-td3": {"ensemble": 2},
    "steve": MODELS,
    "steve-td3": MODELS,
}


@pytest.fixture
def observations(rng: np.random.Generator) -> Floats:
    return rng.normal(size=(40, 3)).astype(np.float32)


def changed(observations: Floats, number: int) -> Floats:
    """The observations with another value of one number."""
    found = observations.copy()
    found[:, number] = found[:, number] * -3 + 1
    return found


def refuse_to_see(policy: Policy, observations: Floats) -> None:
    """The policy acts by the first two numbers, and the third changes no bit of its actions."""
    actions = policy(observations)
    assert np.array_equal(policy(changed(observations, 2)), actions)
    for number in (0, 1):
        assert not np.allclose(policy(changed(observations, number)), actions, atol=1e-4)


SLOW = ("ddpg", "tqc", "crossq", "sunrise", "sunrise-td3", "steve", "steve-td3")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in CASES]
)
def test_no_policy_of_a_run_sees_it(name: str, runs: Path, observations: Floats) -> None:
    """Neither before the first update nor after the last, in memory and in the file."""
    trainer = Trainer(name, ENV, runs=runs, **{**SHORT, **CASES[name]})
    refuse_to_see(trainer.policy(), observations)
    run_to_end(trainer)
    assert trainer.progress.updates > 100
    learners = trainer.loop.learners
    for member, state in enumerate(learners.states):
        refuse_to_see(trainer.policy(member), observations)
        assert (np.asarray(state.actor[0]["kernel"])[..., 2, :] == 0).all()
        assert (np.asarray(state.critic[0]["kernel"])[..., 2, :] != 0).all()
    file = load(trainer.directory.policy_file)
    refuse_to_see(file, observations)
    assert file.about["actor_observes"] == ":2"
    averages: Averages | None = getattr(trainer.loop, "averages", None)
    if name == "multi-td3":
        assert averages is not None
        means = averages.policies(trainer.policy(), [trainer.policy()] * 2, [trainer.policy()] * 2)
        assert means.keys() == {"members", "ema", "snapshots"}
        for mean in [each for several in means.values() for each in several]:
            refuse_to_see(mean, observations)


@pytest.mark.parametrize("name", ["td3", "sac"])
def test_gradients(name: str, runs: Path, observations: Floats) -> None:
    """Of the action exactly 0 in what is hidden; of the critics' values not."""
    trainer = Trainer(name, ENV, runs=runs, **SHORT)
    run_to_end(trainer)
    learner: Any = trainer.loop.learners.compiled.learner
    (state,) = trainer.loop.learners.states
    action = jnp.zeros((len(observations), 1))
    by_actor = jax.grad(lambda x: mlp.apply(state.actor, x).sum())(jnp.asarray(observations))
    by_critic = jax.grad(lambda x: learner.values(state.critic, x, action).sum())(
        jnp.asarray(observations)
    )
    assert (by_actor[:, 2] == 0).all()
    assert (by_actor[:, :2] != 0).any(axis=0).all()
    assert (by_critic != 0).any(axis=0).all()


@pytest.mark.parametrize(("name", "acting"), [("td3", "actor"), ("sac", "apply")])
def test_it_learns_as_from_observations_without_it(
    name: str, acting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As learners whose losses give the actor zeros there; here its weights are set to 0."""
    spec, updates = Spec(observation_size=5, action_size=2), 6
    hyper = resolve(name, "Walker2d-v5", {"hidden": (8, 8), "actor_observes": "0,3:"}).hyper
    learner = algorithms.find(name)(spec, hyper)
    compiled, layout = of_transitions(learner, 0), Layout(spec)
    shape = (updates, learner.updates_per_call, 16, layout.width)
    rows = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    seen = np.array([True, False, False, True, True])
    original = getattr(mlp, acting)

    def masked(network: Any, x: Any, *others: Any) -> Any:
        if network[0]["kernel"].shape[0] == 5:  # an actor, since critics also take an action
            x = jnp.where(seen, x, 0)
        return original(network, x, *others)

    def learned(program: CompiledLearner) -> Any:
        (state,) = (compiled.blinded(each) for each in program.init(1, same=False))
        still = np.zeros(5, np.float32), np.ones(5, np.float32)
        for call in range(updates):
            state = program.update(state, 0, UpdateInputs(call, rows[call], None, still)).state
        return state

    found = learned(compiled)
    monkeypatch.setattr(mlp, acting, masked)
    plain = replace(learner, hyper=replace(hyper, actor_observes=None))
    wanted = learned(of_transitions(plain, 0))
    assert (np.asarray(found.actor[0]["kernel"])[seen] != 0).all()
    for network in ("actor", "critic", "target_critic"):
        for one, two in zip(
            jax.tree.leaves(getattr(found, network)),
            jax.tree.leaves(getattr(wanted, network)),
            strict=True,
        ):
            np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-7)


def test_every_form_of_the_policy(runs: Path, observations: Floats) -> None:
    """ONNX and SB3's take the whole observation, as the policy file does, and see as little."""
    trainer = Trainer("sac", ENV, runs=runs, **SHORT, normalize_observation=True)
    policy = load(run_to_end(trainer).policy_file)
    model = SB3Policy(policy)
    assert np.array_equal(model.predict(observations)[0], policy(observations))
    refuse_to_see(replace(policy, about={}), observations)
    onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    session = onnxruntime.InferenceSession(build(policy), providers=["CPUExecutionProvider"])

    def act(x: Floats) -> Floats:
        return session.run(None, {"observation": x})[0]

    actions = act(observations)
    np.testing.assert_allclose(actions, policy(observations), rtol=1e-4, atol=1e-4)
    assert np.array_equal(act(changed(observations, 2)), actions)
    assert not np.allclose(act(changed(observations, 0)), actions, atol=1e-4)
    assert session.get_modelmeta().custom_metadata_map["actor_observes"] == ":2"


def test_resume_is_exact(runs: Path) -> None:
    settings = {**SHORT, "members": 2, "rule": "best", "copy": "weights", "steps": 460}
    whole = Trainer("td3", ENV, runs=runs, name="whole", **settings)
    cut = Trainer("td3", ENV, runs=runs, name="cut", **settings)
    stop_at(cut, 180)
    assert_same(run_to_end(whole), run_to_end(Trainer.resume(cut.directory.path)))


@pytest.mark.parametrize("from_file", [False, True])
def test_a_start_from_an_actor_that_saw_all(
    runs: Path, observations: Floats, from_file: bool
) -> None:
    old = Trainer("td3", ENV, runs=runs, name="old", **{**SHORT, "actor_observes": None})
    directory = run_to_end(old)
    assert "actor_observes" not in load(directory.policy_file).about
    source = directory.policy_file if from_file else directory.path
    new = Trainer("td3", ENV, runs=runs, name="new", start_from=str(source), **SHORT)
    refuse_to_see(new.policy(), observations)
    new.close()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("0:2", [0, 1]),
        (":-1", [0, 1, 2]),
        ("-1", [3]),
        ("0,3", [0, 3]),
        ("2:,0", [0, 2, 3]),
        ("-3:-1", [1, 2]),
        (":", [0, 1, 2, 3]),
    ],
)
def test_numbers_and_ranges(words: str, found: list[int]) -> None:
    assert [n for n, is_in in enumerate(chosen("a", words, 4)) if is_in] == found


@pytest.mark.parametrize("words", ["4", "0:5", "2:2", "3:1", "-5", "-5:", "0,7"])
def test_numbers_that_there_are_not(words: str) -> None:
    with pytest.raises(UsageError, match=r"^a: .* is not among the 4 numbers"):
        chosen("a", words, 4)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("td3 --actor-observes 0:4", "actor_observes: 0:4 is not among the 3 numbers 0:3"),
        ("td3 --actor-observes speed", "actor_observes: is no list of numbers and ranges"),
        ("td3 --actor-observes 0:2:1", "actor_observes: is no list of numbers and ranges"),
        (f"td3 --actor-observes {'9' * 5_000}", "actor_observes: is no list of numbers"),
        ("td7 --actor-observes 0:2", "actor_observes: TD7 cannot hide anything from its actor"),
        (
            "td3 --actor-observes 0:2 --actor-layer-norm --exploration parameter",
            "exploration: would put noise on weights that --actor-observes keeps at 0",
        ),
        ("trpo --actor-observes 0:2", "--actor-observes"),
    ],
)
def test_what_cannot_be_is_one_line(
    words: str, said: str, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And leaves no folder."""
    algorithm, *flags = words.split()
    assert main(["train", algorithm, ENV, *flags, "--runs", str(runs)]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not runs.exists()

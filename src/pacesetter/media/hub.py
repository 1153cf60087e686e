"""Policies on the Hugging Face hub; nothing is sent or fetched but by these two calls."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pacesetter.envs import Recipe
from pacesetter.errors import UsageError
from pacesetter.evaluation import Evaluation, evaluate, recipe_of
from pacesetter.extras import need
from pacesetter.files import present
from pacesetter.policy import FILE, Policy, load
from pacesetter.runs import RunDirectory
from pacesetter.text import markdown, printable

INSTALL = "pacesetter[hub]"
CARD, VIDEO = "README.md", "replay.mp4"  # the hub plays a replay.mp4
USE = """```python
from pacesetter.media.hub import load_from_hub

policy = load_from_hub("{repo_id}")
action = policy(observation)  # in the env's units
```"""


def push(
    policy_file: str | Path,
    repo_id: str,
    *,
    video: str | Path | None = None,
    command: str | None = None,
    private: bool = False,
    episodes: int = 10,
    seed: int = 0,
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> str:
    """Send a policy file and a model card, in one commit, to `repo_id` (USER/NAME); its address.

    The card has the mean return of `episodes` fresh episodes from `seed`. `command` is what trained
    it, by default what its run folder says. Who sends is known from `hf auth login` or HF_TOKEN.
    Needs the extra `hub`.
    """
    hub, path = need("hub", "huggingface_hub", INSTALL), Path(policy_file)
    policy = load(path)
    task = recipe_of(policy.about, env, env_kwargs)
    _refuse_another(task, policy.about)
    if video is not None and Path(video).suffix != ".mp4":
        raise UsageError(f"video: {video} must end in .mp4")
    fresh = evaluate(policy, task, episodes, seed)
    text = card(policy, repo_id, fresh, seed, command or _command(path))
    files = {FILE: path, CARD: text.encode()} | ({VIDEO: Path(video)} if video else {})
    about = policy.about
    message = f"{about.get('algorithm', 'policy')} on {about.get('env')}, by pacesetter"
    with _one_line(repo_id):
        operations = [
            hub.CommitOperationAdd(path_in_repo=name, path_or_fileobj=file)
            for name, file in files.items()
        ]
        api = hub.HfApi(library_name="pacesetter")
        api.create_repo(repo_id, private=private, exist_ok=True)
        return str(api.create_commit(repo_id, operations, commit_message=message).repo_url)


def load_from_hub(repo_id: str, filename: str = FILE, *, revision: str | None = None) -> Policy:
    """Fetch a policy file (kept in the hub's cache) and load it; nothing in it is executed."""
    hub = need("hub", "huggingface_hub", INSTALL)
    with _one_line(repo_id):
        path = hub.hf_hub_download(repo_id, filename, revision=revision, library_name="pacesetter")
    return load(path)


def _refuse_another(task: Recipe, about: dict[str, Any]) -> None:
    """Refuse a return on another task than the one that the card names."""
    own = about.get("env"), about.get("env_kwargs", {}), tuple(about.get("wrap", ()))
    names = ("env", "env", "wrap")
    for name, given, trained in zip(names, (task.name, task.kwargs, task.wrap), own, strict=True):
        if given != trained:
            raise UsageError(
                f"{name}: the card tells of the task that the policy was trained on; leave out "
                "--env, --env.KEY and --wrap"
            )


@contextmanager
def _one_line(repo_id: str) -> Generator[None]:
    """What the hub or the way to it refuses, in one line."""
    errors = need("hub", "huggingface_hub.errors", INSTALL)
    kinds = (OSError, ValueError, errors.HTTPError, errors.EntryNotFoundError)
    try:
        yield
    except kinds as error:
        hint = ""
        if isinstance(error, (errors.LocalTokenNotFoundError, errors.RepositoryNotFoundError)):
            hint = "; check the name, and log in with `hf auth login`"
        raise UsageError(f"hub: {repo_id}: {str(error) or type(error).__name__}{hint}") from None


def _command(path: Path) -> str | None:
    """The command line of the run in whose folder the policy lies, if it lies in one."""
    run = RunDirectory(path.parent)
    return run.record().get("command") if present(run.config_file) else None


def card(
    policy: Policy, repo_id: str, fresh: Evaluation, seed: int, command: str | None = None
) -> str:
    """The text of the model card: what it is, what it scored, how it was made, how to use it."""
    about = policy.about
    rows = [
        ("task", about.get("env")),
        ("algorithm", about.get("algorithm")),
        ("training", f"{about.get('step', 0):,} env steps, seed {about.get('seed')}"),
        ("return", f"{_score(fresh)} over {len(fresh.returns)} fresh episodes, seed {seed}"),
    ]
    if isinstance(about.get("score"), (int, float)):
        rows.append(
            (
                "return in training",
                f"{about['score']:,.1f} over {about.get('score_episodes')} episodes",
            )
        )
    made_with = about.get("versions")
    found = made_with.items() if isinstance(made_with, dict) else ()
    versions = (f"{name} {number}" for name, number in found)
    rows.append(("versions", ", ".join(versions)))
    table = "\n".join(f"| {name} | {markdown(str(value))} |" for name, value in rows)
    trained = f"\n## Training\n\n```\n{printable(command)}\n```\n" if command else ""
    return (
        f"---\n{_data(policy, fresh)}\n---\n\n# {about.get('algorithm')} on {about.get('env')}\n\n"
        f"A policy trained by pacesetter. Returns are undiscounted sums of rewards, "
        f"mean +- standard deviation over episodes.\n\n| | |\n|---|---|\n{table}\n{trained}\n"
        f"## Use\n\n{USE.format(repo_id=repo_id)}\n"
    )


def _score(fresh: Evaluation) -> str:
    return f"{fresh.mean:,.1f} +- {fresh.std:,.1f}"


def _data(policy: Policy, fresh: Evaluation) -> str:
    """The card's YAML, by which the hub sorts and ranks models."""
    hub = need("hub", "huggingface_hub", INSTALL)
    env, algorithm = str(policy.about.get("env")), str(policy.about.get("algorithm"))
    kind = "reinforcement-learning"
    result = hub.EvalResult(
        task_type=kind,
        task_name=kind,
        dataset_type=env,
        dataset_name=env,
        metric_type="mean_reward",
        metric_name="mean_reward",
        metric_value=f"{fresh.mean:.2f} +/- {fresh.std:.2f}",
    )
    return hub.ModelCardData(
        library_name="pacesetter",
        tags=[kind, "deep-reinforcement-learning", "pacesetter", algorithm, env],
        model_name=algorithm,
        eval_results=[result],
    ).to_yaml()

"""The verbs `export`, `push` and `fetch`: a policy for other programs and other people."""

import shlex
from pathlib import Path

from pacesetter.cli.flags import parser
from pacesetter.cli.policies import add_run, add_seed, parse
from pacesetter.cli.streams import aside
from pacesetter.errors import UsageError, writing
from pacesetter.policy import FILE

TARGETS = "onnx (a model for any runtime), minari (a data set), sb3 (a script)"


def export(words: list[str]) -> int:
    """Write a policy as ONNX, a Minari data set or for SB3."""
    command = parser("export", "Write a policy in the form of another program.")
    add_run(command)
    add = command.add_argument
    add("--to", required=True, metavar="FORM", help=TARGETS)
    out = "what to write: walk.onnx, data/walk-v0 or walk.py"
    add("-o", required=True, metavar="OUT", help=out)
    episodes = "episodes of a data set (default 100)"
    add("--episodes", type=int, default=100, metavar="N", help=episodes)
    add_seed(command)
    given, found = parse(command, words)
    from pacesetter.media.export import export

    how = {"episodes": given.episodes, "seed": given.seed}
    with aside():
        made = export(found.policy, given.to, given.o, **found.task, **how)
    print(made)
    return 0


def push(words: list[str]) -> int:
    """Publish a policy on the Hugging Face hub."""
    command = parser("push", "Send a policy file and a model card to the Hugging Face hub.")
    command.epilog = "Log in by `hf auth login`, or set HF_TOKEN. Nothing else is sent."
    add_run(command)
    add = command.add_argument
    add("repo", metavar="REPO_ID", help="where to, such as USER/cheetah; made if it is not there")
    add("--video", metavar="FILE", help="a .mp4 to show beside it; `pacesetter record` makes one")
    add("--private", action="store_true", help="make a new repository private")
    episodes = "fresh episodes whose return the card tells (default 10)"
    add("--episodes", type=int, default=10, metavar="N", help=episodes)
    add_seed(command)
    given, found = parse(command, words)
    from pacesetter.media.hub import push

    how = {"video": given.video, "private": given.private, "episodes": given.episodes}
    with aside():
        page = push(found.file, given.repo, **how, seed=given.seed, **found.task)
    print(page)
    return 0


def fetch(words: list[str]) -> int:
    """Fetch a policy from the Hugging Face hub."""
    command = parser(
        "fetch", "Fetch a policy from the Hugging Face hub; nothing in it is executed."
    )
    add = command.add_argument
    add("repo", metavar="REPO_ID", help="where from, such as USER/cheetah")
    add("-o", metavar="FILE", help="a .safetensors (default NAME.safetensors of USER/NAME)")
    add("--file", default=FILE, metavar="NAME", help=f"name of the file there (default {FILE})")
    add("--revision", metavar="REV", help="branch, tag or commit (default the newest)")
    given = command.parse(words)
    file = Path(given.o or f"{given.repo.split('/')[-1]}.safetensors")
    _refuse(file)
    from pacesetter.media.hub import load_from_hub

    policy = load_from_hub(given.repo, given.file, revision=given.revision)
    with writing("fetch", file):
        policy.save(file)
    about = policy.about
    see = shlex.join(["pacesetter", "eval", str(file)])
    made = f"{about.get('algorithm', 'a policy')} on {about.get('env', 'no named task')}"
    print(f"{file}: {made}, step {about.get('step', 0):,}; see `{see}`")
    return 0


def _refuse(file: Path) -> None:
    """Refuse a file that could not be written or used, before anything is fetched."""
    if file.suffix != ".safetensors":
        raise UsageError(f"fetch: {file} must end in .safetensors")
    if file.exists():
        raise UsageError(f"fetch: {file} exists; give another name with -o")
    if not file.parent.is_dir():
        raise UsageError(f"fetch: cannot write {file}: No such file or directory")

"""Build the wheel, install it in an empty environment per Python, and use it there.

    python scripts/try_wheel.py             # 3.11, 3.12 and 3.13
    python scripts/try_wheel.py 3.13        # one of them

Needs those Pythons on PATH or under pyenv. Ends with 1 unless every one was proved.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

VERSIONS = ("3.11", "3.12", "3.13")
TRAIN = (
    "train td3 Pendulum-v1 --steps 300 --warmup 100 --eval-every 200 --eval-episodes 1 "
    "--hidden 16 16 --quiet"
)
COMMANDS = (
    "--version",
    "--help",
    "list algorithms",
    TRAIN,
    "eval Pendulum-v1/td3/0 --episodes 1",
    "record champion:HalfCheetah-v4-sac --frames 2 -o walk.gif",
)


def interpreter(version: str) -> str | None:
    """The newest Python of a minor version: from PATH, else from pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    every = pyenv.glob(f"versions/{version}.*/bin/python")
    kept = sorted((path for path in every if re.fullmatch(r"[\d.]+", path.parts[-3])), key=numbers)
    found = [shutil.which(f"python{version}"), *map(str, reversed(kept))]
    return next((path for path in found if path and answers(path, version)), None)


def numbers(path: Path) -> list[int]:
    """Those of the version in a path, by which 3.11.10 comes after 3.11.9."""
    return [int(number) for number in re.findall(r"\d+", path.parents[1].name)]


def answers(path: str, version: str) -> bool:
    """Whether it starts and is of that version; pyenv's shims may do neither."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    result = subprocess.run([path, "-c", code], capture_output=True, text=True)
    return result.returncode == 0 and result.stdout.strip() == version


def prove(python: str, wheel: Path, folder: Path) -> None:
    """Install the wheel into a new environment in `folder` and run the commands there."""
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    call([python, "-m", "venv", str(folder / "venv")], folder, plain)
    programs = folder / "venv" / "bin"
    install = [str(programs / "pip"), "install", "--quiet", "--disable-pip-version-check"]
    call([*install, str(wheel)], folder, plain)
    call([str(programs / "pip"), "check"], folder, plain)
    for command in COMMANDS:
        call([str(programs / "pacesetter"), *command.split()], folder, plain)


def call(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Run one command; what it printed is shown only if it fails."""
    result = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    if result.returncode:
        shown = " ".join([Path(words[0]).name, *words[1:]])
        raise RuntimeError(f"`{shown}` gave {result.returncode}:\n{result.stdout}{result.stderr}")


def main(versions: list[str]) -> int:
    """Prove each version in turn; 0 if all are proved."""
    root = Path(__file__).parents[1]
    failed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", str(root)]
        call([*build, "--wheel-dir", str(folder)], folder, dict(os.environ))
        (wheel,) = folder.glob("*.whl")
        for version in versions:
            place = folder / version
            place.mkdir()
            python = interpreter(version)
            if python is None:
                verdict = "not proved: no such Python on PATH or under pyenv"
            else:
                try:
                    prove(python, wheel, place)
                    verdict = f"proved with {wheel.name}"
                except RuntimeError as error:
                    verdict = f"not proved: {error}"
            failed = failed or verdict.startswith("not")
            print(f"Python {version}: {verdict}", flush=True)
            shutil.rmtree(place)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or list(VERSIONS)))

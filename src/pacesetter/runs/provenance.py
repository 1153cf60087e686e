"""What a result needs to be repeated: command, versions, commit, machine, threads, libraries."""

import os
import platform
import shlex
import shutil
import subprocess
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pacesetter.process import cores, threads

NUMBERS = {"family": "cpu family", "model": "model"}  # of a processor in /proc/cpuinfo
PACKAGES = ("pacesetter", "jax", "jaxlib", "optax", "numpy", "gymnasium", "mujoco", "safetensors")


def provenance(**found: Any) -> dict[str, Any]:
    """Where this process runs and with what; `found` is what the learner's side knows of that."""
    return {
        "command": shlex.join([_program(), *sys.argv[1:]]),
        "versions": versions(),
        "commit": _commit(),
        "threads": threads(),
        "machine": f"{_processor()}, {len(cores())} of {os.cpu_count()} cores",
        **found,
    }


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide results."""
    return {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}


@cache
def _processor() -> str:
    """Kind of processor, and on Linux its model, of which names alone often say little."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    found = {name.strip(): value.strip() for name, _, value in (x.partition(":") for x in lines)}
    words = [found.get("model name", "")]
    words += [f"{name} {found[key]}" for name, key in NUMBERS.items() if key in found]
    return ", ".join([platform.machine(), *filter(None, words)])


def _program() -> str:
    """How to call what runs: `python -m pacesetter` is the same as `pacesetter`."""
    name = Path(sys.argv[0]).name
    return "pacesetter" if name == "__main__.py" else name


def _commit() -> str | None:
    checkout = Path(__file__).parents[3]
    if not (checkout / ".git").exists() or not (git := shutil.which("git")):
        return None
    describe = [git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    found = subprocess.run(describe, cwd=checkout, capture_output=True, check=False)
    return found.stdout.decode(errors="replace").strip() or None

"""What is said in several files is the same in all of them."""

import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def read(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text())


def test_one_version() -> None:
    assert read("CITATION.cff")["version"] == PROJECT["version"]
    newest = re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest
    assert newest[1] == PROJECT["version"]


def test_same_pythons() -> None:
    """Those that are promised are those that CI runs and that `make wheel` proves."""
    prefix = "Programming Language :: Python :: "
    minors = [line.removeprefix(prefix) for line in PROJECT["classifiers"] if "3." in line]
    assert (
        read(".github/workflows/ci.yml")["jobs"]["test"]["strategy"]["matrix"]["python"] == minors
    )
    script = (ROOT / "scripts" / "try_wheel.py").read_text()
    assert f"VERSIONS = {tuple(minors)}".replace("'", '"') in script
    assert PROJECT["requires-python"] == f">={minors[0]}"


def test_the_newest_python_is_tried() -> None:
    numbers = runpy.run_path(str(ROOT / "scripts" / "try_wheel.py"))["numbers"]
    kept = [Path(f"versions/{name}/bin/python") for name in ("3.11.9", "3.11.10", "3.11.2")]
    assert [path.parts[1] for path in sorted(kept, key=numbers)] == ["3.11.2", "3.11.9", "3.11.10"]


def test_targets_that_pages_name_are_there() -> None:
    made = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "AGENTS.md", "CHANGELOG.md")]
    text = "\n".join(page.read_text() for page in [*pages, *ROOT.glob("docs/**/*.md")])
    named = set(re.findall(r"^make ([\w-]+)|`make ([\w-]+)`", text, re.MULTILINE))
    assert {one or other for one, other in named} <= made
    assert len(named) > 4


def test_the_image_has_what_the_build_needs() -> None:
    """All that pyproject.toml and its build hook read is copied, and nothing else is sent."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    wheel = tool["targets"]["wheel"]
    needed = {*wheel["force-include"], *(Path(name).parts[0] for name in wheel["packages"])}
    needed |= {"pyproject.toml", "hatch_build.py", PROJECT["readme"], *PROJECT["license-files"]}
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    copied = {word for line in lines if line.startswith("COPY ") for word in line.split()[1:-1]}
    assert copied == needed
    sent = (ROOT / ".dockerignore").read_text().split()
    assert {line.removeprefix("!") for line in sent if line != "*"} == needed

"""The site is whole: strict, without a request to a network, with all that the code offers."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import pacesetter
from pacesetter.algorithms import TABLE
from pacesetter.cli.main import VERBS

ROOT = Path(__file__).parents[2]
LOADING = re.compile(r"<(?:script|img|link|iframe)\b[^>]*>")
OUTSIDE = re.compile(r"(?:src|href)=\"?(?:https?:)?//")


def build(config: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """What `make docs` runs."""
    command = [sys.executable, "-m", "mkdocs", "build", "-f", str(config), "-d", str(site)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def titles(page: Path) -> set[str]:
    """The headings of a built page."""
    found = re.findall(r"<h[123] [^>]*>(.*?)<a", page.read_text(), re.DOTALL)
    return {re.sub(r"<.*?>", "", title).strip() for title in found}


@pytest.mark.slow
def test_site_is_whole(tmp_path: Path) -> None:
    result = build(ROOT / "mkdocs.yml", tmp_path)
    assert result.returncode == 0, result.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 40
    tags = [tag for page in pages for tag in LOADING.findall(page.read_text())]
    assert len(tags) > len(pages)
    assert [tag for tag in tags if OUTSIDE.search(tag)] == []
    assert titles(tmp_path / "reference/python.html") >= {
        *pacesetter.__all__, "Report", "Policy", "record", "SB3Policy", "tracked"
    }  # fmt: skip
    assert titles(tmp_path / "reference/cli.html") >= {f"pacesetter {verb}" for verb in VERBS}
    assert titles(tmp_path / "reference/settings.html") >= TABLE.keys()
    assert "--policy-delay" in (tmp_path / "reference/settings.html").read_text()
    assert "class Balloon" in re.sub(
        r"<.*?>", "", (tmp_path / "source/examples/balloon.py.html").read_text()
    )


@pytest.mark.slow
def test_broken_links_are_errors(tmp_path: Path) -> None:
    docs = shutil.copytree(ROOT / "docs", tmp_path / "docs")
    broken = ("../src/pacesetter/gone.py", "gone.md", "index.md#gone")
    with (docs / "faq.md").open("a") as page:
        page.write("".join(f"\n[broken]({link})\n" for link in broken))
    config = tmp_path / "mkdocs.yml"
    places = {"INHERIT": ROOT / "mkdocs.yml", "docs_dir": docs}
    lines = [f"{name}: {path}\n" for name, path in places.items()]
    config.write_text("".join(lines) + f"hooks: [{ROOT / 'scripts' / 'site_pages.py'}]\n")
    result = build(config, tmp_path / "site")
    assert result.returncode == 1
    said = result.stdout + result.stderr
    assert all(f"contains a link '{link}'" in said for link in broken)
    assert f"Aborted with {len(broken)} warnings in strict mode" in said

"""Nothing in the package depends on the command line, and no test on another."""

import re
from pathlib import Path

import pytest

import pacesetter

PACKAGE = Path(pacesetter.__file__).parent


@pytest.mark.parametrize("folder", [path.name for path in PACKAGE.iterdir() if path.is_dir()])
def test_only_the_command_imports_the_command(folder: str) -> None:
    files = [] if folder == "cli" else list((PACKAGE / folder).rglob("*.py"))
    pattern = re.compile(r"^\s*(from|import) pacesetter\.cli\b", re.MULTILINE)
    assert [path.name for path in files if pattern.search(path.read_text())] == []


def test_no_test_imports_another() -> None:
    tests = sorted(Path(__file__).parent.rglob("test_*.py"))
    found = [
        str(test)
        for test in tests
        if re.search(r"^\s*(from|import) test_", test.read_text(), re.MULTILINE)
    ]
    assert tests
    assert not found, "what tests share belongs in tests/helpers or a conftest.py"

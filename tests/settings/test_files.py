"""Files of settings are UTF-8 on every machine, and so is all text that the package reads."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pacesetter
from pacesetter.errors import UsageError
from pacesetter.settings.files import read_file

READ = "import sys; from pacesetter.settings.files import *; print(read_file(Path(sys.argv[1])))"
PACKAGE = Path(pacesetter.__file__).parent
UNNAMED = re.compile(r'read_text\(\)|write_text\([^,\n]*\)$|\.open\(("[arwx]\+?")?\)', re.M)


@pytest.mark.parametrize(("name", "text"), [("a.toml", 'name = "a"'), ("a.json", '{"name": "a"}')])
def test_a_byte_order_mark_is_no_text(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_file(tmp_path / name) == {"name": "a"}


def test_a_name_that_is_no_word_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"settings": {"name": []}}')
    with pytest.raises(UsageError, match="they cannot be those of td3"):
        read_file(tmp_path / "a.json", "td3")


def test_the_locale_decides_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes('# später\nname = "Žák"'.encode())
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-X", "warn_default_encoding", "-c", READ, tmp_path / "a.toml"]
    environment = os.environ | plain | {"PYTHONIOENCODING": "ascii:backslashreplace"}
    done = subprocess.run(command, env=environment, capture_output=True, check=True)
    assert done.stdout == b"{'name': '\\u017d\\xe1k'}\n"
    assert b"EncodingWarning" not in done.stderr


def test_text_is_read_and_written_by_a_named_encoding() -> None:
    root = Path(__file__).parents[2]
    every = [path for folder in (PACKAGE, root / "scripts") for path in folder.rglob("*.py")]
    every.append(root / "results" / "summary.py")
    assert [path for path in every if UNNAMED.search(path.read_text("utf-8"))] == []

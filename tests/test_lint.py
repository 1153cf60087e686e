"""`make check` refuses what runs code out of data; a rule that is dropped shows here."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# What each would bring in, and the rule that must refuse it.
BAD = {
    "import pickle\n\npickle.loads(b'')\n": ["S301", "TID251"],
    "import marshal\n\nmarshal.loads(b'')\n": ["S302", "TID251"],
    "from cloudpickle import loads\n\nloads(b'')\n": ["TID251"],
    "import numpy as np\n\nnp.load('x', allow_pickle=True)\n": ["TID251"],
    "eval('1')\n": ["S307"],
    "exec('1')\n": ["S102"],
    "import yaml\n\nyaml.load('1', Loader=yaml.UnsafeLoader)\n": ["S506"],
}


@pytest.mark.parametrize("place", ["src/pacesetter/new.py", "scripts/new.py", "tests/new.py"])
@pytest.mark.parametrize("code", BAD)
def test_code_out_of_data_is_refused(code: str, place: str) -> None:
    command = [sys.executable, "-m", "ruff", "check", "--output-format", "concise", "-"]
    name = ["--stdin-filename", str(ROOT / place)]
    found = subprocess.run(
        [*command, *name], input=code, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert found.returncode == 1, found
    assert all(f" {rule} " in found.stdout for rule in BAD[code]), found.stdout

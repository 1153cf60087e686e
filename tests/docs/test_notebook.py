"""The notebook runs from top to bottom, draws, and compares what it trained."""

import base64
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "walk.ipynb"


def test_no_output_is_kept() -> None:
    """What git holds is the text alone."""
    cells: Any = nbformat.read(NOTEBOOK, 4).cells
    code = [cell for cell in cells if cell.cell_type == "code"]
    assert code
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)


@pytest.mark.slow
def test_notebook_trains_watches_and_compares(tmp_path: Path) -> None:
    """In a process of its own, since Jupyter's own warnings are no faults of ours."""
    written = tmp_path / "walk.ipynb"
    written.write_text(NOTEBOOK.read_text())
    command = [sys.executable, "-m", "jupyter", "execute", "--inplace", str(written)]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    cells: Any = nbformat.read(written, 4).cells
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    printed = "".join(output.get("text", "") for output in outputs)
    assert len(pictures) == 1
    (film,) = [
        output.data["image/gif"] for output in outputs if "image/gif" in output.get("data", {})
    ]
    assert base64.b64decode(film).startswith(b"GIF89a")
    returns = re.findall(r"^(td3|multi-td3|random actions): -?\d+ \+- \d+$", printed, re.MULTILINE)
    assert returns == ["td3", "multi-td3", "random actions"]
    (shown,) = [
        output.data["text/html"] for output in outputs if "text/html" in output.get("data", {})
    ]
    for name in ("td3", "multi-td3"):
        assert re.search(rf"<td[^>]*>{name}\s*</td>", shown), shown
    assert not [path for path in tmp_path.iterdir() if path != written]

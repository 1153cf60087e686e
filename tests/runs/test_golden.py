"""Runs of every schema so far, kept for good, are listed, shown, compared and evaluated."""

import json
import shutil
from pathlib import Path

import pytest

from pacesetter import policy, storage
from pacesetter.cli.main import main
from pacesetter.ensemble.progress import Progress
from pacesetter.runs import SCHEMA, RunDirectory
from pacesetter.training import identity

DATA = Path(__file__).parents[1] / "data"
# A run of 260 steps of multi-td3 on Pendulum-v1, without its replay: folder and two fresh returns.
GOLDEN = {
    "run-1-checkpoint-4": {
        "policy_file": [-1378.0234, -1290.7319],
        "best_file": [-1360.5659, -1328.6910],
    }
}


@pytest.fixture(params=GOLDEN)
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> RunDirectory:
    return RunDirectory(Path(shutil.copytree(DATA / request.param, tmp_path / request.param)))


def test_today_has_a_golden_run() -> None:
    """A new schema needs a folder of its own; those of old ones stay."""
    assert f"run-{SCHEMA}-checkpoint-{identity.SCHEMA}" in GOLDEN
    assert {path.name for path in DATA.glob("run-*")} == GOLDEN.keys()
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 100_000


def test_a_golden_run_is_read(golden: RunDirectory, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["show", golden.path], ["compare", golden.path]):
        assert main([str(word) for word in words]) == 0
    assert main(["list", "runs", "--runs", str(golden.path.parent)]) == 0
    text = capsys.readouterr().out
    assert text.count("260 of 260") == 2
    assert "damaged" not in text
    assert golden.config().run.members == 2
    assert [row["step"] for row in golden.rows("eval")] == [0, 100, 200, 260]
    table = storage.read(golden.state_file, "checkpoint").table
    assert Progress.load(table["progress"]).step == 260
    assert identity.identity(golden.config()) == table["run"]


@pytest.mark.parametrize("file", ["policy_file", "best_file"])
def test_a_golden_policy_acts(
    golden: RunDirectory, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = getattr(golden, file)
    assert policy.load(path).about["env"] == "Pendulum-v1"
    assert main(["eval", str(path), "--episodes", "2", "--json"]) == 0
    returns = json.loads(capsys.readouterr().out)["returns"]
    assert returns == pytest.approx(GOLDEN[golden.path.name][file], rel=1e-4)

"""The first sentence of a comparison: who is ahead, and whether the runs can tell."""

import re
from pathlib import Path

import pytest
from compare import make_run

from pacesetter.study.compare.comparison import compare
from pacesetter.study.report.headline import headline


def runs(folder: Path, levels: dict[str, float], seeds: int, env: str = "Ant-v5") -> None:
    for name, level in levels.items():
        for seed in range(seeds):
            make_run(folder, env, name, seed, level=level, budget=40_000, evaluations=10)


@pytest.mark.parametrize(
    ("levels", "seeds", "said"),
    [
        ({"td3": 1_000}, 1, ["td3 on Ant-v5 has a final return of", "(1 run of 40k steps)"]),
        ({"td3": 1_000, "sac": 2_000}, 1, ["sac has the highest", "cannot tell this from chance"]),
        ({"td3": 1_000, "sac": 1_010}, 3, ["cannot tell the two apart", "3 runs of 40k steps"]),
        ({"td3": 1_000, "sac": 9_000}, 3, ["sac", "beyond chance", "fewer than 5 seeds"]),
        ({"td3": 1_000, "sac": 9_000}, 5, ["highest final return, ", "beyond chance"]),
        ({"td3": 9_000, "sac": 5, "crossq": 50}, 5, ["td3 has the", "of 3 algorithms"]),
    ],
)
def test_one_task(levels: dict[str, float], seeds: int, said: list[str], tmp_path: Path) -> None:
    runs(tmp_path, levels, seeds)
    line = headline(compare([tmp_path]))
    assert [word for word in said if word not in line] == []
    assert ("indicative" in line) == (seeds == 3 and "beyond" in line)
    assert (line[-1], line.count(". ")) == (".", 0)


def test_several_tasks_are_counted_against_the_control(tmp_path: Path) -> None:
    runs(tmp_path, {"td3": 1_000, "sac": 9_000, "multi-td3": 100}, 5)
    runs(tmp_path, {"td3": 1_000, "sac": 9_000, "multi-td3": 1_000}, 5, "Walker2d-v5")
    line = headline(compare([tmp_path]))
    assert "sac is ahead on 2 of 2 tasks" in line
    assert "multi-td3 is behind on 1 of 2 tasks and not told apart on 1 of 2 tasks" in line
    assert "indicative" not in line
    without = headline(compare([tmp_path], reference="ddpg"))
    assert "sac on 2" in without
    assert "ddpg is not among the runs" in without


def test_tasks_without_a_rival_are_not_ranked(tmp_path: Path) -> None:
    runs(tmp_path / "one", {"td3": 1_000}, 3)
    runs(tmp_path / "one", {"td3": 1_000}, 3, "Walker2d-v5")
    assert headline(compare([tmp_path / "one"])) == (
        "td3 was run on 2 tasks, beside no other algorithm."
    )
    runs(tmp_path / "apart", {"td3": 1_000}, 3)
    runs(tmp_path / "apart", {"sac": 1_000}, 3, "Walker2d-v5")
    line = headline(compare([tmp_path / "apart"]))
    assert "td3 was run beside no other, so no difference is tested." in line


def test_single_runs_are_not_told_apart_by_an_interval(tmp_path: Path) -> None:
    for env in ("Ant-v5", "Walker2d-v5"):
        runs(tmp_path, {"td3": 1_000, "sac": 2_000}, 1, env)
    assert "sac is of too few runs to tell on 2 of 2 tasks" in headline(compare([tmp_path]))


def test_what_is_not_known_is_not_ranked(tmp_path: Path) -> None:
    """A largest return is of evaluations after the first update, which some runs never had."""
    for name, level in (("td3", 1_000), ("sac", 2_000)):
        make_run(tmp_path, "Ant-v5", name, level=level, budget=20_000, evaluations=10)
    line = headline(compare([tmp_path], metric="max"))
    assert line == "No maximum return is known: no evaluation came after a first update."
    make_run(tmp_path, "Ant-v5", "ddpg", budget=100_000, evaluations=10)
    line = headline(compare([tmp_path], metric="max", mixed=True))
    assert line.startswith("ddpg on Ant-v5 has a maximum return of")
    assert "Not known, without an evaluation after the first update: sac on Ant-v5, td3" in line
    assert "inf" not in line


def test_a_control_that_made_no_update_is_still_among_the_runs(tmp_path: Path) -> None:
    for env in ("Ant-v5", "Walker2d-v5"):
        runs(tmp_path, {"td3": 9_000, "sac": 1_000, "ddpg": 500}, 3, env)
    for path in tmp_path.glob("*/*/*/metrics.jsonl"):
        if path.parts[-3] != "td3":
            path.write_text(path.read_text().replace('"updates": 0', '"updates": 9'))
    line = headline(compare([tmp_path], budget="20k"))
    assert "sac on 2; td3 has no known return beside another's, so no difference is tested." in line
    (tmp_path / "alone").mkdir()
    for env in ("Ant-v5", "Walker2d-v5"):
        for name in ("td3", "sac"):
            (tmp_path / env / name).rename(tmp_path / "alone" / f"{env}-{name}")
    line = headline(compare([tmp_path / "alone"], budget="20k"))
    assert line.startswith("sac was run on 2 tasks, beside none whose return is known.")
    assert "td3 on Ant-v5, td3 on Walker2d-v5." in line
    alone = tmp_path / "alone"
    for path in (
        *alone.glob("Ant-v5-td3/*/metrics.jsonl"),
        *alone.glob("Ant-v5-sac/*/metrics.jsonl"),
    ):
        made = "9" if "td3" in str(path.parts[-3]) else "0"
        path.write_text(re.sub(r'"updates": [09]', f'"updates": {made}', path.read_text()))
    line = headline(compare([alone], budget="20k"))
    assert "td3 has no known return beside another's" in line, "on either task"


def test_who_made_no_update_is_not_ahead(tmp_path: Path) -> None:
    """Its warm-up is longer than the budget, and what it scores is luck."""
    runs(tmp_path, {"td3": 9_000, "sac": 1_000}, 5)
    for path in tmp_path.glob("*/sac/*/metrics.jsonl"):  # whose warm-up was shorter
        path.write_text(path.read_text().replace('"updates": 0', '"updates": 9'))
    found = compare([tmp_path], budget="20k")
    line = headline(found)
    assert line.startswith("sac on Ant-v5 has a final return of")
    assert "Not known, without an evaluation after the first update: td3 on Ant-v5." in line
    (note,) = [each for each in found.notes if each.startswith("Made no update")]
    assert "Ant-v5 td3 seed 4" in note
    assert "sac" not in note
    assert not any(each.startswith("Made no") for each in compare([tmp_path]).notes)


def test_a_control_that_is_not_there_is_told(tmp_path: Path) -> None:
    runs(tmp_path, {"td3": 1_000, "sac": 9_000}, 1)
    note = "No algorithm tt3 is among the runs, so none is compared with it."
    assert note in compare([tmp_path], reference="tt3").notes
    assert note not in compare([tmp_path], reference="sac").notes

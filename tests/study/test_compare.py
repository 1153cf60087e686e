"""Comparing runs: what is found, what is refused, what the tables say, and that all forms agree."""

import csv
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare import make_run
from matplotlib.figure import Figure
from scripted_runs import IDLE, start
from short_runs import TINY, run_to_end

from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory
from pacesetter.study.compare import lineage, stats
from pacesetter.study.compare.comparison import compare
from pacesetter.study.compare.gathering import gather
from pacesetter.study.compare.groups import Comparison, split
from pacesetter.study.compare.results import AXES, Run, compact
from pacesetter.study.report import contents, contrasts, curves, output, paper, tables
from pacesetter.study.report.figures import figure_2
from pacesetter.study.report.published import sources
from pacesetter.training.trainer import Trainer

ROOT = Path(__file__).parents[2]
SELECTED = [5, 0.0, 1.0, [0], 0]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five seeds of three algorithms on two tasks, each 100k steps with 20 evaluations."""
    folder = tmp_path_factory.mktemp("runs")
    for env in ("HalfCheetah-v5", "Ant-v5"):
        for name, level in (("td3", 4_000.0), ("multi-td3", 3_000.0), ("sac", 5_000.0)):
            for seed in range(5):
                make_run(folder, env, name, seed, level=level, budget=100_000, evaluations=20)
    return folder


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def small(folder: Path, env: str = "Ant-v5", name: str = "td3", seed: int = 0, **more: Any) -> Path:
    return make_run(folder, env, name, seed, budget=20_000, evaluations=10, **more)


# Finding.


def test_runs_are_found_by_folder_tail_pattern_and_file(runs: Path, tmp_path: Path) -> None:
    def names(*words: str) -> list[str]:
        found = gather(words, runs)
        assert not found.empty
        assert not found.damaged
        return sorted(f"{run.env}/{run.name}/{run.seed}" for run in found.runs)

    td3 = [f"HalfCheetah-v5/td3/{seed}" for seed in range(5)]
    assert names(str(runs / "HalfCheetah-v5" / "td3")) == td3
    assert names("HalfCheetah-v5/td3") == td3
    assert names("HalfCheetah-v5/td3/3") == td3[3:4]
    assert names("HalfCheetah-*/td3") == td3
    assert names("HalfCheetah-v5/t*/[01]") == td3[:2]
    assert len(names("td3")) == 10
    assert names("HalfCheetah-v5/td3", str(runs / "HalfCheetah-v5" / "td3" / "0")) == td3
    file = tmp_path / "results.jsonl"
    line = compact(RunDirectory(runs / "HalfCheetah-v5" / "td3" / "4"))
    file.write_text(json.dumps(line) + "\n")
    assert names(str(file)) == td3[4:]


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("nothing/9", "'nothing/9' not found"),
        ("no*", "matches no run"),
        ("a.txt", "neither a run's"),
    ],
)
def test_what_is_not_found_is_one_line(runs: Path, word: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(UsageError, match=re.escape(said)):
        gather([word], runs)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"commit": None, "versions": ...}, "no versions"),
        ({"schema": 7}, "schema 7"),
        ({"columns": ["step"]}, "columns must begin"),
        ({"evaluations": [[0, [math.nan], 0, 0, 0, 0]]}, "evaluations.0.1: should be"),
        ({"evaluations": [[0, [], 0, 0, 0, 0]]}, "evaluations.0.1: "),
        ({"evaluations": [[0]]}, "damaged or foreign"),
        ({"selections": [[5, 0.0, 1.0, [0], 9]]}, "champion must be of 1 members"),
        ({"varied": [{"gamma": [0.9]}, {"gamma": [0.9]}]}, "varied: must have a row"),
        ({"varied": [{"gamma": [0.9, 0.8]}]}, "1 values of each setting"),
        ({"varied": [{"gamma": "high"}]}, "varied.0.gamma"),
        ({"selections": [SELECTED], "varied": [{"tau": [1]}, {"x": [1]}]}, "varied: must name"),
        ({"resumed": [{"versions": 3}]}, "resumed.0.versions"),
        ({"settings": {}}, "is missing"),
    ],
)
def test_a_foreign_line_is_refused(
    runs: Path, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    line = compact(RunDirectory(runs / "Ant-v5" / "td3" / "0")) | change
    line = {key: value for key, value in line.items() if value is not ...}
    file = tmp_path / "results.jsonl"
    file.write_text(json.dumps(line) + "\n")
    (why,) = gather([file]).damaged
    assert re.search(said, why)
    with pytest.raises(UsageError, match=f"none can be read: .*{said}"):
        compare([file])


@pytest.mark.parametrize("odd", [{"lr_horizon": "20k"}, {"replay_horizon": [1]}, {"rule": []}])
def test_an_odd_setting_is_refused(tmp_path: Path, odd: dict[str, Any]) -> None:
    run = small(tmp_path, select_window=None, **odd)
    with pytest.raises(UsageError, match=f"settings.{next(iter(odd))}: should be"):
        compare([run], budget=10_000)


def test_a_line_without_one_of_its_keys_is_read_or_refused(runs: Path, tmp_path: Path) -> None:
    line = compact(RunDirectory(runs / "Ant-v5" / "td3" / "0"))
    file, read = tmp_path / "results.jsonl", 0
    short = [{k: v for k, v in line.items() if k != key} for key in line]
    for key in line["settings"]:
        settings = {k: v for k, v in line["settings"].items() if k != key}
        short.append(line | {"settings": settings})
    for each in short:
        file.write_text(json.dumps(each) + "\n")
        found = gather([file])
        read += len(found.runs)
        assert all(re.search("is missing|no ", why) for why in found.damaged)
        if found.runs:
            compare([file])
    assert 0 < read < len(short)


def _no_config(run: RunDirectory) -> None:
    run.config_file.unlink()
    run.config_file.mkdir()


DAMAGES: dict[str, Callable[[RunDirectory], object]] = {
    "config": lambda run: run.config_file.write_text("{"),
    "config a folder": _no_config,
    "log cut": lambda run: run.metrics_file.write_text('{"kind": "eval", "st\n'),
    "log of bytes": lambda run: run.metrics_file.write_bytes(b"\xff\xfe\n"),
    "row without a step": lambda run: run.metrics_file.write_text('{"kind": "eval"}\n'),
    "steps that fall": lambda run: run.metrics_file.write_text(
        "".join(reversed(run.metrics_file.read_text().splitlines(keepends=True)))
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_left_out(
    damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The others are compared, and a line says what is left out; alone it is refused."""
    whole, broken = small(tmp_path / "runs"), small(tmp_path / "runs", seed=1)
    DAMAGES[damage](RunDirectory(broken))
    for words in (["td3"], [str(whole), str(broken)], ["Ant-*/t*"]):
        assert main(["compare", *words, "-o", "table.md"]) == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("pacesetter: left out: ")
        assert str(broken) in line or "Ant-v5/td3/1" in line
        assert "Left out: " in Path("table.md").read_text()
    Path("table.md").unlink()
    assert main(["compare", str(broken), "-o", "table.md"]) == 2
    assert capsys.readouterr().err.startswith("pacesetter: run: none can be read: ")
    assert not Path("table.md").exists()


def test_a_damaged_line_of_results_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [json.dumps(compact(RunDirectory(small(tmp_path, seed=seed)))) for seed in (0, 1)]
    Path("r.jsonl").write_bytes(f"{lines[0]}\n{{\n{lines[1]}\n".encode() + b"\xff\n")
    assert main(["compare", "r.jsonl"]) == 0
    said = capsys.readouterr()
    assert [line.split(": ")[2] for line in said.err.splitlines()] == ["r.jsonl:2", "r.jsonl:4"]
    assert "n=2" in said.out


# What may stand side by side.


def test_several_versions_of_a_task_are_refused_unless_mixed(tmp_path: Path) -> None:
    small(tmp_path, "Ant-v4")
    small(tmp_path, "Ant-v5")
    with pytest.raises(UsageError, match=r"Ant in the versions v4, v5.*--mixed"):
        compare([tmp_path])
    found = compare([tmp_path], mixed=True)
    assert found.envs == ["Ant-v4", "Ant-v5"]
    assert "Mixed, so no fair comparison: env: Ant in the versions v4, v5." in found.notes
    assert re.search(r"\(v4, .*\(v5, ", tables.plain([contents.overview(found)]))


def test_several_budgets_are_refused_unless_cut_or_mixed(tmp_path: Path) -> None:
    small(tmp_path, seed=0)
    make_run(tmp_path, "Ant-v5", "td3", 1, budget=40_000, evaluations=20)
    with pytest.raises(UsageError, match=r"runs of 20,000, 40,000 env steps; --budget"):
        compare([tmp_path])
    assert compare([tmp_path], mixed=True).budget is None
    cut = compare([tmp_path], budget="20k")
    assert cut.budget == 20_000
    assert [len(run.steps) for run in cut.runs] == [11, 11]
    assert [run.updates[-1] for run in cut.runs] == [0, 0]  # a cut run's ledger is cut too


def test_one_budget_for_runs_that_evaluate_at_other_steps(tmp_path: Path) -> None:
    """None of them has an evaluation at the budget, and a smaller one would not help either."""
    make_run(tmp_path, "Ant-v5", "td3", budget=120_000, evaluations=24)
    make_run(tmp_path, "Ant-v5", "sac", budget=120_000, evaluations=40)
    found = compare([tmp_path], budget="100k")
    assert [run.clock[-1] for run in found.runs] == [99_000, 100_000]
    assert any("(eval_every)" in note for note in found.notes)


def test_equal_cpu_time_cuts_each_run_where_it_stood(tmp_path: Path) -> None:
    """Runs of other lengths need no --mixed then; one that never spent so much is left out."""
    small(tmp_path, seed=0)
    make_run(tmp_path, "Ant-v5", "td3", 1, budget=40_000, evaluations=20)
    spent = sorted(run.cpu[-1] for run in compare([tmp_path], mixed=True).runs)
    cut = compare([tmp_path], cpu=spent[0])
    assert len(cut.runs) == 2
    assert all(run.cpu[-1] <= spent[0] for run in cut.runs)
    assert f"Every run counts up to {spent[0]:,.0f} CPU seconds." in cut.notes
    alone = compare([tmp_path], cpu=spent[1])
    assert [run.seed for run in alone.runs] == [1]
    assert "CPU seconds)" in alone.notes[0]
    with pytest.raises(UsageError, match="cpu: limits runs otherwise than --budget does"):
        compare([tmp_path], cpu="1m", budget="10k")


def test_a_setting_that_only_newer_runs_have_is_no_difference(tmp_path: Path) -> None:
    small(tmp_path, seed=0)
    small(tmp_path, seed=1, count_selection_steps=True)
    assert len(compare([tmp_path]).runs) == 2


def test_a_run_from_before_there_was_eval_policy_evaluated_the_champion(tmp_path: Path) -> None:
    """Its seeds are not pooled with those of an average; between groups a line says it."""
    small(tmp_path, seed=0)
    small(tmp_path, seed=1, eval_policy="champion")
    small(tmp_path, name="sac", eval_policy="champion")
    assert not any("(eval_policy)" in note for note in compare([tmp_path]).notes)
    small(tmp_path, name="crossq", eval_policy="ema")
    assert any("(eval_policy)" in note for note in compare([tmp_path]).notes)
    small(tmp_path, seed=2, eval_policy="ema")
    with pytest.raises(UsageError, match="td3 has eval_policy champion and ema"):
        compare([tmp_path])


def test_a_new_seed_of_an_older_run_evaluates_as_it_did(tmp_path: Path) -> None:
    settings: dict[str, Any] = {**TINY, "steps": 100}
    first = Trainer("td3", "Pendulum-v1", runs=tmp_path, **settings)
    run_to_end(first)
    file = first.directory.config_file
    table = json.loads(file.read_text())
    del table["settings"]["eval_policy"]
    file.write_text(json.dumps(table))
    with pytest.raises(UsageError, match="eval_policy=champion, not ema"):
        Trainer("td3", "Pendulum-v1", runs=tmp_path, **settings, seed=1, eval_policy="ema")
    Trainer("td3", "Pendulum-v1", runs=tmp_path, **settings, seed=1).close()


def test_uncounted_selection_steps_are_told(tmp_path: Path) -> None:
    small(tmp_path, name="multi-td3", count_selection_steps=False)
    assert any("Steps of selection come on top" in note for note in compare([tmp_path]).notes)


def test_a_version_is_of_the_task_and_not_of_its_keywords() -> None:
    assert split("Walker2d-v5") == ("Walker2d", "v5")
    kept = "xml_file=robot-v1.xml"
    assert split(f"Walker2d-v5 {kept}") == (f"Walker2d {kept}", "v5")
    assert split(f"mine:Robot {kept}") == (f"mine:Robot {kept}", "-")


def test_the_paper_suites_ant_stands_in_the_papers_tables(tmp_path: Path) -> None:
    make_run(tmp_path, "pacesetter/Ant111-v4", "multi-td3", budget=20_000, evaluations=10)
    text = tables.plain(paper.tables(compare([tmp_path])))
    assert "(v4, 111, n=1, 20k" in text


def test_other_settings_under_one_name_are_refused(tmp_path: Path) -> None:
    small(tmp_path, seed=0)
    small(tmp_path, seed=1, batch_size=100)
    with pytest.raises(UsageError, match="td3 has batch_size 256 and 100"):
        compare([tmp_path])
    assert "batch_size" in compare([tmp_path], mixed=True).notes[0]


@pytest.mark.parametrize(("key", "given"), [("select_window", 5), ("select_after", 3_000)])
def test_a_default_and_its_value_spelled_out_are_one_setting(
    tmp_path: Path, key: str, given: int
) -> None:
    same = {"rule": "rescue", "warmup": 3_000}
    small(tmp_path, seed=0, **same, **{key: None})
    small(tmp_path, seed=1, **same, **{key: given})
    assert len(compare([tmp_path]).runs) == 2
    small(tmp_path, seed=2, **same, **{key: given + 1})
    with pytest.raises(UsageError, match=f"td3 has {key} {given} and {given + 1}"):
        compare([tmp_path])


def test_the_same_seed_twice_is_refused(tmp_path: Path) -> None:
    small(tmp_path / "a")
    small(tmp_path / "b")
    with pytest.raises(UsageError, match="both Ant-v5 td3 seed 0"):
        compare([tmp_path])


def test_unfinished_runs_are_left_out_and_named(tmp_path: Path) -> None:
    for seed in range(3):
        small(tmp_path, seed=seed)
    short = make_run(tmp_path, "Ant-v5", "td3", 3, budget=10_000, evaluations=5, planned=20_000)
    started = small(tmp_path, seed=4)
    (started / "metrics.jsonl").write_text("")
    found = compare([tmp_path])
    assert [run.seed for run in found.runs] == [0, 1, 2]
    assert f"{short} (10,000 of 20,000 env steps)" in found.notes[0]
    assert f"{started} (no evaluation)" in found.notes[0]
    assert "Indicative only, for fewer than 5 seeds: Ant-v5 td3 (n=3)." in found.notes
    with pytest.raises(UsageError, match="none is complete"):
        compare([short])


def test_a_run_that_its_time_limit_ended_counts(tmp_path: Path) -> None:
    make_run(tmp_path, budget=10_000, evaluations=5, planned=20_000, time=40.0)
    assert compare([tmp_path]).budget == 10_000


def test_evaluations_count_at_the_steps_at_which_they_were_due(tmp_path: Path) -> None:
    """Two members end a tick a step late; the last one stops at an odd budget."""
    path = make_run(tmp_path, budget=10_000, evaluations=5, planned=10_500)
    rows = RunDirectory(path).rows()
    for row in rows:
        row["step"] += row["step"] == 8_000
    rows.append([row for row in rows if row["kind"] == "eval"][-1] | {"step": 10_500})
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (run,) = gather([path]).runs
    assert run.clock.tolist() == [0, 2_000, 4_000, 6_000, 8_000, 10_000, 10_500]
    assert run.steps[4] == 8_001
    assert run.finished
    assert run.cut(8_000).clock[-1] == 8_000


@pytest.mark.parametrize("evaluations", [1, 2])
def test_the_first_short_run_is_compared_and_labelled(evaluations: int, tmp_path: Path) -> None:
    """A newcomer's run of two evaluations counts by the last, which is said beside it."""
    for name in ("td3", "sac"):
        run = make_run(tmp_path, "Ant-v5", name, budget=4_000, evaluations=max(evaluations - 1, 1))
        if evaluations == 1:
            last = (run / "metrics.jsonl").read_text().splitlines()[-2:]
            kept = [line for line in last if '"eval"' in line]
            (run / "metrics.jsonl").write_text("\n".join(kept) + "\n")
    found = compare([tmp_path], metric="auc" if evaluations == 1 else "final")
    assert [len(run.steps) for run in found.runs] == [evaluations] * 2
    last = [run.returns[-1] for run in found.runs]
    assert [group.values("final")[0] for group in found.groups] == last
    (note,) = [line for line in found.notes if "the last one counts alone" in line]
    assert f"Ant-v5 sac seed 0 ({evaluations})" in note
    assert "last evaluation alone" in contents.overview(found).rows[0][1].text
    assert all(np.isfinite(group.values("auc")).all() for group in found.groups)


def test_no_chance_to_be_better_from_fewer_than_three_runs_a_side(tmp_path: Path) -> None:
    for seeds in range(3):
        for name, level in (("td3", 1_000), ("sac", 2_000)):
            small(tmp_path, name=name, seed=seeds, level=level)
        cell = contrasts.against(compare([tmp_path]))[0].rows[0][4]
        assert cell.text == ("1.00" if seeds == 2 else "-")


# Numbers.


def test_tables_hold_the_statistics_of_the_rows(runs: Path) -> None:
    found = compare([runs])
    group = found.find("Ant-v5", "td3")
    assert group is not None
    finals: list[float] = []
    for seed in range(5):
        rows = RunDirectory(runs / "Ant-v5" / "td3" / str(seed)).rows()
        finals.append(np.mean([row["mean"] for row in rows if row["kind"] == "eval"][-3:]))
    np.testing.assert_allclose(group.values("final"), finals, atol=1e-3)
    mean = stats.mean(np.array(finals))
    cell = contents.overview(found).rows[0][1]
    assert cell.text == f"{mean.value:,.0f} [{mean.low:,.0f}; {mean.high:,.0f}] (v5, n=5, 100k)"
    assert found.names == ["td3", "multi-td3", "sac"]
    control = contrasts.against(found)[0].rows
    assert [row[1].text for row in control] == ["multi-td3", "sac"] * 2


def wins(x: Any, y: Any) -> float:
    """Share of the pairs of runs in which x is above y."""
    return float(np.mean([one > other for one in x for other in y]))


def test_contrasts_are_what_the_algorithm_has_more_than_the_control(runs: Path) -> None:
    """Positive where it is better, in percent of the control's mean; by loops over all pairs."""
    found = compare([runs])
    values = {(group.env, group.name): group.values("final") for group in found.groups}
    (against,) = contrasts.against(found)
    for row in against.rows:
        env, name = row[0].text, row[1].text
        x, y = values[env, name], values[env, "td3"]
        gap, welch = x.mean() - y.mean(), stats.difference(x, y)
        assert (gap > 0) == (name == "sac")
        assert row[2].text == f"{gap:,.0f} [{welch.low:,.0f}; {welch.high:,.0f}]"
        assert welch.low < gap < welch.high
        assert row[3].text == f"{100 * (x.mean() / y.mean() - 1):,.1f}%"
        assert row[4].key == wins(x, y) != 0.5
        spread = (stats.deviation(x), stats.deviation(y))
        seeds = [stats.seeds_needed(e * y.mean(), spread) for e in (gap / y.mean(), 0.1, 0.2, 0.3)]
        assert [cell.key for cell in row[5:]] == seeds
    (together,) = contrasts.together(found)
    for row in together.rows:
        if (name := row[0].text) != "td3":
            chances = [wins(values[env, name], values[env, "td3"]) for env in found.envs]
            assert row[4].key == pytest.approx(np.mean(chances))
            assert (np.mean(chances) > 0.5) == (name == "sac")


def test_percents_of_a_negative_control_keep_their_sign(tmp_path: Path) -> None:
    """Half of a penalty is 50% better."""
    for name, level in (("td3", 4_000), ("sac", 2_000)):
        path = small(tmp_path, name=name, level=level)
        rows = RunDirectory(path).rows()
        for row in (row for row in rows if row["kind"] == "eval"):
            row["returns"] = [-value for value in row["returns"]]
        (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = compare([tmp_path])
    x, y = (_finals(found, "Ant-v5", name)[0] for name in ("sac", "td3"))
    (row,) = contrasts.against(found)[0].rows
    assert row[3].text == f"{100 * (1 - x / y):,.1f}%"
    assert y < x < 0


def test_max_and_levels_ignore_policies_that_have_learned_nothing(tmp_path: Path) -> None:
    """Ant's untrained policy stands still for a return of 1,000."""
    path = make_run(tmp_path, "Ant-v5", budget=100_000, evaluations=20, level=500)
    rows = RunDirectory(path).rows()
    for row in rows:
        if row["kind"] == "eval" and row["step"] <= 25_000:
            row["returns"] = [1_001.0]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (run,) = gather([path]).runs
    assert run.metric("max") < 800
    assert run.reached(1_000) == math.inf
    early = run.cut(30_000)
    assert early.metric("final") == early.returns[-1] < 800
    assert run.cut(20_000).metric("final") == pytest.approx(1_001)  # there is no other


def test_every_cell_of_the_paper_has_its_version_and_a_file_has_one_ledger(runs: Path) -> None:
    found = compare([runs])
    shown = output.own(found)
    titles = [table.title for table in shown]
    assert titles == [
        "Final return",
        "Against td3",
        "Each group",
        "Better rewards sooner",
        "All tasks together",
        "Best of two independent runs",
        "Selections",
        "What a mean run spent",
    ]
    assert [table.title for table in paper.tables(found)] == [
        "The paper's table I",
        "The paper's table II",
        "Published returns",
    ]
    spent = ["env steps", "updates", "transitions", "CPU s", "wall s"]
    assert shown[-1].headers == ["env", "algorithm", "runs", *spent]
    assert len(shown[-1].rows) == len(found.groups)
    for table in [*shown, *paper.tables(found)]:
        assert all(len(row) == len(table.headers) for row in table.rows)
    for which in ("I", "II"):
        table = paper.paper_table(found, which)
        assert table is not None
        cells = [cell.text for row in table.rows for cell in row[2:] if cell.text != "-"]
        assert all(re.search(r" \(v[1-5], n=", cell) for cell in cells)
    words = [row[2].text for row in paper.published(found).rows]  # pyright: ignore
    assert all(re.search(r"\(v[1-5]\)$", word) for word in words)


def test_what_an_algorithm_counts_of_its_own_is_in_the_ledger(tmp_path: Path) -> None:
    path = small(tmp_path)
    rows = [row | {"model_steps": 7 * row["step"]} for row in RunDirectory(path).rows()]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    small(tmp_path, name="sac")
    ledger = contents.ledger(compare([tmp_path], budget=10_000).groups)
    assert ledger.headers[-1] == "model steps"
    assert [row[-1].text for row in ledger.rows] == ["0", "70,000"]


def test_best_of_two_spends_what_it_says(runs: Path) -> None:
    found = compare([runs])
    group = found.find("Ant-v5", "td3")
    assert group is not None
    row = contrasts.best_of_two(found)[0].rows[0]
    half = stats.best_of_two(group.cut(50_000).values("final"))
    whole = stats.best_of_two(group.values("final"))
    assert [cell.key for cell in row[-2:]] == [half.value, whole.value]
    assert half.value < whole.value > group.values("final").mean()


def test_results_of_a_file_equal_those_of_the_runs(runs: Path, tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    lines = [compact(RunDirectory(path.parent)) for path in runs.rglob("config.json")]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    a, b = compare([runs]), compare([file])
    assert tables.plain(output.own(a)) == tables.plain(output.own(b))
    assert a.notes == b.notes


def test_scores_are_over_the_published_scale(runs: Path) -> None:
    found = compare([runs])
    group = found.find("Ant-v5", "td3")
    assert group is not None
    scores = contrasts.shared(found)["td3"]
    np.testing.assert_allclose(scores[0], group.values("final") / 4185)
    one = compare([runs / "Ant-v5"])
    assert contrasts.shared(one) == {}
    assert contrasts.together(one) == []


# Lineages.


def test_lineages_are_followed_through_copies() -> None:
    rows = [
        [10, 5.0, 10.0, [0, 0, 2], 0],
        [20, 30.0, 10.0, [1, 1, 2], 1],
        [30, 0.0, 0.0, [0, 0, 1], 2],
    ]
    found = lineage.Selections.of(rows)
    assert found.ancestors.tolist() == [[0, 0, 2], [0, 0, 2], [0, 0, 0]]
    assert found.founding == "0, since selection 3"
    assert found.line == [0, 1, 1]  # place 2 comes from 1, which came from 1, which came from 0
    assert found.ratios.tolist() == [0.5, 3.0, 0.0]
    assert found.flips.tolist() == [True, False, True]
    assert lineage.Selections.of(rows[:2]).founding == "2 of 3 founders left"


def test_settings_are_followed_along_the_champions_line(tmp_path: Path) -> None:
    """A run of pbt, in which place 0 takes over place 3's state: the table tells the gamma that
    the final champion's line had at each selection, as the log has it.
    """
    returns, vary = [[1, 1, 9], [2], [3], [4]], {"gamma": (0.9, 0.95, 0.98, 0.99)}
    pbt = {
        "members": 4,
        "rule": "pbt",
        "select_window": 1,
        "vary": vary,
        "steps": 120,
        "eval_every": 40,
    }
    directory = run_to_end(start(tmp_path, returns, (10,) * 4, **pbt, **IDLE))
    after = [row["settings"]["gamma"] for row in directory.rows("select")]
    assert [row["parents"] for row in directory.rows("select")] == [
        [3, 1, 2, 3], [3, 1, 2, 3], [0, 0, 2, 3],
    ]  # fmt: skip
    (table,) = contrasts.settings(compare([directory.path]))
    (row,) = [[cell.text for cell in row] for row in table.rows]
    assert row[3:5] == ["gamma", "0.9 0.95 0.98 0.99"]
    assert row[5] == lineage.shorten([0.99, 0.99, after[1][0], after[2][0]])
    assert row[6] == " ".join(map(str, after[2]))


def test_a_return_never_reached_and_a_gap_without_an_error() -> None:
    never = contents.soon(np.array([np.inf, np.inf, 1.0]))
    assert (never.text, never.key) == ("never (1 of 3)", np.inf)
    assert tables.number(math.inf, 2).text == "inf"


def test_a_line_is_shortened_at_its_start() -> None:
    assert lineage.shorten([0, 1, 1, 0]) == "0 1x2 0"
    assert lineage.shorten([0, 1] * 10, most=3) == "... 1 0 1"


# Curves.


def test_curves_are_the_mean_of_evaluations_on_each_axis(runs: Path) -> None:
    group = compare([runs]).find("Ant-v5", "td3")
    assert group is not None
    line = curves.curve(group, "steps")
    np.testing.assert_allclose(line.x, group.runs[0].clock)
    np.testing.assert_allclose(line.mean, np.mean([run.returns for run in group.runs], axis=0))
    updates = curves.curve(group, "updates")
    assert updates.x[0] == 0
    assert updates.mean[0] == pytest.approx(line.mean[5])  # 25,000 steps, the last without updates
    for axis in ("cpu", "wall"):
        assert curves.curve(group, axis).mean[-1] == pytest.approx(line.mean[-1])


def test_algorithms_of_the_paper_keep_their_colours() -> None:
    found = curves.style(["td3", "a", "multi-td3", *(f"b{n}" for n in range(6))])
    assert found["multi-td3"] == ("#0072B2", "")
    assert found["td3"] == ("#D55E00", "")
    assert len(set(found.values())) == len(found)


def test_published_numbers_are_whole() -> None:
    for source in sources():
        assert source["version"] in {"v1", "v2", "v3", "v4"}
        assert source["cite"]
        assert ("budget" in source) + ("budgets" in source) + ("said" in source) == 1
        for values in source["returns"].values():
            assert len(values) == len(source["budgets"]) if "budgets" in source else values
    assert split("pacesetter/Ant111-v4") == ("Ant", "v4, 111")


# The command.


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def run(*words: object) -> tuple[int, str, str]:
        code = main(["compare", *map(str, words)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_without_a_file_a_table_is_printed(runs: Path, command: Any) -> None:
    code, out, err = command(runs, "--metric", "auc")
    assert (code, err) == (0, "")
    assert out.startswith("Against td3, by the 95% interval of the difference in mean return of")
    assert "\nMean return of training\n" in out
    assert out.count("What a mean run spent") == 1
    assert "Against td3" in out


def test_the_reference_and_the_budget_are_handed_on(runs: Path, command: Any) -> None:
    code, out, err = command(runs, "--reference", "multi-td3", "--cpu", "300s", "--mixed")
    assert (code, err) == (0, "")
    assert out.startswith("Against multi-td3")
    assert "Every run counts up to 300 CPU seconds." in out


def test_files_are_written_in_each_form(runs: Path, tmp_path: Path, command: Any) -> None:
    words = ["-o", "a.md", "-o", "a.tex", "-o", "a.pdf", "--published", "--smooth", "5"]
    code, out, _ = command(runs, *words)
    assert (code, out.split()) == (0, ["a.md", "a.tex", "a.pdf"])
    markdown, tex = Path("a.md").read_text(), Path("a.tex").read_text()
    assert markdown.count("What a mean run spent") == 1
    assert tex.count("\\begin{table}") == tex.count("\\end{table}") == 12
    assert "11719$\\pm$" not in tex
    assert "12,139.5 $\\pm$ 292.7 (v2, n=3, 1M episodes)" in tex
    assert not re.search(r"(?<!\\)%", re.sub(r"^%.*|\{%$", "", tex, flags=re.M))
    pdf = Path("a.pdf").read_bytes()
    assert pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") == 7


def _finals(found: Comparison, env: str, name: str) -> Any:
    group = found.find(env, name)
    assert group is not None
    return group.values("final")


def test_data_and_pictures(runs: Path, command: Any) -> None:
    """JSON and CSV hold the numbers of the tables; PNG and SVG show every algorithm and task."""
    found = compare([runs])
    words = ["-o", "a.json", "-o", "a.csv", "-o", "a.png", "-o", "a.svg"]
    assert command(runs, *words)[0] == 0
    told = json.loads(Path("a.json").read_text())
    with Path("a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert told["result"].startswith("Against td3")
    for group, one, row in zip(found.groups, told["groups"], rows, strict=True):
        mean = stats.mean(group.values("final"))
        assert (one["env"], one["algorithm"]) == (row["env"], row["algorithm"])
        assert one["metrics"]["final"]["value"] == mean.value == float(row["final"])
        assert one["metrics"]["final"]["high"] == mean.high == float(row["final_high"])
        assert one["ledger"]["updates"] == float(row["updates"])
        assert [run["seed"] for run in one["runs"]] == [0, 1, 2, 3, 4]
        returns = one["runs"][0]["evaluations"]["return"]
        assert returns == group.runs[0].returns.tolist()
        assert (one["difference"] is None) == (group.name == "td3") == (row["difference"] == "")
        if group.name != "td3":
            x, y = (_finals(found, group.env, name) for name in (group.name, "td3"))
            said = stats.difference(x, y)._asdict() | {"p_better": wins(x, y)}
            assert one["difference"] == said
            columns = {"value": row["difference"]}
            columns |= {key: row[f"difference_{key}"] for key in ("low", "high", "p_better")}
            assert {key: float(text) for key, text in columns.items()} == said
            assert (said["value"] > 0) == (said["p_better"] > 0.5) == (group.name == "sac")
    assert Path("a.png").read_bytes().startswith(b"\x89PNG")
    svg = Path("a.svg").read_text()
    assert svg.count('<g id="axes_') == 2 * len(found.envs)
    for word in (*found.envs, *found.names):
        assert word in svg, word


def test_a_notebook_shows_the_result_and_the_table(runs: Path) -> None:
    found = compare([runs / "Ant-v5"])
    text = found._repr_html_()
    assert text.startswith("<p>On Ant-v5, sac has the highest final return of 3 algorithms")
    assert text.count("<tr") == 1 + len(found.names)
    assert contents.overview(found).rows[0][1].text in text


def test_data_of_one_short_run_has_no_nan(tmp_path: Path, command: Any) -> None:
    """What is not known is null in JSON and empty in CSV."""
    run = make_run(tmp_path, budget=4_000, evaluations=1)
    assert command(run, "-o", "a.json", "-o", "a.csv", "-o", "a.svg")[0] == 0
    assert "NaN" not in Path("a.json").read_text()
    assert "nan" not in Path("a.csv").read_text()
    assert json.loads(Path("a.json").read_text())["groups"][0]["metrics"]["final"]["low"] is None


def test_smoothing_is_said_and_changes_no_number(runs: Path, command: Any) -> None:
    command(runs, "-o", "a.html", "--no-film", "--smooth", "9")
    command(runs, "-o", "b.html", "--no-film")
    a, b = Path("a.html").read_text(), Path("b.html").read_text()
    assert "Savitzky-Golay, window 9, order 3" in a
    assert "Savitzky-Golay" not in b
    rows = [re.findall(r"<td.*?</td>", page) for page in (a, b)]
    assert rows[0] == rows[1]


def test_curves_of_one_seed_are_smoothed_though_they_have_no_interval(
    tmp_path: Path, command: Any
) -> None:
    run = make_run(tmp_path, budget=20_000, evaluations=10)
    found = compare([run])
    raw, smoothed = (curves.curve(found.groups[0], "steps", window) for window in (None, 5))
    assert not np.allclose(raw.mean, smoothed.mean)
    assert np.isnan(smoothed.low).all()
    assert np.isnan(smoothed.high).all()
    for file in ("a.png", "a.pdf", "a.html"):
        assert command(run, "-o", file, "--no-film", "--smooth", "5")[0] == 0


def test_figure_2_takes_each_pair_from_the_first_comparison_that_has_it(tmp_path: Path) -> None:
    """The paper's two tables have budgets of their own, so their runs are not pooled."""
    folders = {"short": (10_000, ("multi-td3", "sunrise")), "long": (90_000, ("multi-td3", "td3"))}
    folders["longest"] = (200_000, ("multi-td3", "td3"))
    for folder, (budget, names) in folders.items():
        for name in names:
            make_run(tmp_path / folder, "Ant-v4", name, budget=budget, evaluations=5)
    short, long, longest = (compare([tmp_path / folder]) for folder in folders)
    panels = [panel for panel in figure_2([short, long, longest]).axes if panel.get_visible()]
    assert [panel.get_title() for panel in panels] == [
        "Ant, multi-td3 and sunrise",
        "Ant, multi-td3 and td3",
    ]
    assert [panel.get_xlabel() for panel in panels] == ["env steps to 10k", "env steps to 90k"]
    assert figure_2([compare([tmp_path / "short/Ant-v4/sunrise"])]) is None


def test_figure_2_names_each_algorithm_once_though_a_task_has_two_versions(tmp_path: Path) -> None:
    for env in ("Ant-v4", "Ant-v5"):
        for name in ("multi-td3", "td3"):
            make_run(tmp_path, env, name, budget=10_000, evaluations=5)
    (panel,) = figure_2([compare([tmp_path], mixed=True)]).axes
    assert panel.get_title() == "Ant, multi-td3 and td3"
    assert len(panel.lines) == 4


def test_a_picture_is_drawn_against_the_axis_asked_for(runs: Path, command: Any) -> None:
    """A .svg names its axis; without the flag that is env steps."""
    for words, said in (([], AXES["steps"]), (["--axis", "cpu"], AXES["cpu"])):
        assert command(runs, "-o", "a.svg", *words)[0] == 0
        texts = re.findall("<!-- (.*) -->", Path("a.svg").read_text())
        assert [axis for axis in AXES.values() if axis in texts] == [said]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--metric", "best"], "metric: unknown 'best'"),
        (["--budget", "many"], "budget: is not a count"),
        (["-o", "a.doc"], "-o: a.doc must end in .html"),
        (["-o", "none/a.md"], "-o: none is not a folder"),
        (["--smooth", "4"], "smooth: must be an odd number"),
        (["--axis", "time", "-o", "a.png"], "axis: unknown 'time'; allowed: cpu, steps"),
        (["--axis", "cpu", "-o", "a.html"], "axis: it is for the curves of a .png or .svg"),
        (["--budget", "1M"], "none is complete"),
    ],
)
def test_bad_words_are_one_line(
    runs: Path, command: Any, words: list[str], said: str, tmp_path: Path
) -> None:
    code, out, err = command(runs, *words)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert said in err
    assert not list(tmp_path.iterdir())


def test_help_imports_neither_jax_nor_scipy() -> None:
    code = (
        "import sys\nfrom pacesetter.cli.main import main\n"
        "try:\n    main(['compare', '--help'])\nexcept SystemExit:\n    pass\n"
        "print({'jax', 'scipy', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("set()\n")


def test_comparing_imports_no_jax(runs: Path) -> None:
    code = (
        "import sys\nfrom pacesetter.cli.main import main\n"
        f"main(['compare', {str(runs)!r}, '-o', 'a.html', '--no-film'])\n"
        "print('jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "a.html\nFalse\n"


def test_the_reported_tables_come_from_the_repository(tmp_path: Path) -> None:
    script = [sys.executable, ROOT / "results" / "summary.py", "--figures", tmp_path]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    assert "# pilot: budget 100k" in done.stdout
    assert (tmp_path / "pilot.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("suffix", ["png", "pdf", "md"])
def test_a_file_that_cannot_be_written_leaves_the_one_before(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*given: Any, **how: Any) -> None:
        raise OSError(28, "No space left on device")

    for holder, name in ((Figure, "savefig"), (os, "fsync")):
        monkeypatch.setattr(holder, name, fail)
    file = tmp_path / f"table.{suffix}"
    file.write_bytes(b"of yesterday")
    small(tmp_path / "runs")
    assert main(["compare", "td3", "-o", str(file)]) == 2
    assert file.read_bytes() == b"of yesterday"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runs", file.name]


def test_a_wrapped_task_is_another_task(tmp_path: Path) -> None:
    small(tmp_path, name="td3")
    small(tmp_path, name="sac", wrap=["my_mod:Half"])
    found = compare([tmp_path])
    assert found.envs == ["Ant-v5", "Ant-v5 wrap=my_mod:Half"]
    assert not found.find("Ant-v5", "sac")


def test_the_same_seed_twice_is_refused_whatever_it_cost(tmp_path: Path) -> None:
    """Two machines of other speeds stand at other steps after the same time."""
    small(tmp_path, seed=0)
    make_run(tmp_path / "slow", "Ant-v5", "td3", 0, budget=40_000, evaluations=20)
    for more in ({"cpu": "1s"}, {"mixed": True}):
        with pytest.raises(UsageError, match="both Ant-v5 td3 seed 0"):
            compare([tmp_path], **more)


def test_a_limit_below_the_first_evaluation_leaves_nothing(tmp_path: Path) -> None:
    log = small(tmp_path) / "metrics.jsonl"
    dear = log.read_text().replace('"cpu_seconds": 0.0,', '"cpu_seconds": 1.0,')
    log.write_text(dear)
    with pytest.raises(UsageError, match="no evaluation up to"):
        compare([tmp_path], cpu="0.5s")


def test_best_of_two_halves_needs_an_evaluation_at_half(tmp_path: Path) -> None:
    """Of 50,000 steps with an evaluation every 20,000 no half was evaluated."""
    for seed in range(3):
        make_run(tmp_path, "Ant-v5", "td3", seed, budget=100_000, evaluations=5)
    row = contrasts.best_of_two(compare([tmp_path]))[0].rows[0]
    assert row[4].text == "-"


def test_best_of_two_halves_is_of_runs_that_learned(tmp_path: Path) -> None:
    """Half of this budget lies within the warm-up."""
    for seed in range(3):
        make_run(tmp_path, "Ant-v5", "td3", seed, budget=40_000, evaluations=20)
    (row,) = contrasts.best_of_two(compare([tmp_path]))[0].rows
    assert (row[4].text, row[5].text == "-") == ("-", False)


def test_speed_of_a_run_that_made_no_step_is_not_known(tmp_path: Path) -> None:
    for seed in range(3):
        small(tmp_path, seed=seed)
    (row,) = contents.speed(compare([tmp_path], budget="100")).rows
    assert [cell.text for cell in row[-2:]] == ["-", "-"]


def test_settings_that_end_a_run_are_checked(runs: Path) -> None:
    line = compact(RunDirectory(runs / "Ant-v5" / "td3" / "0"))
    line["settings"]["stop_at"] = "5"
    Path("r.jsonl").write_text(json.dumps(line) + "\n")
    assert "stop_at" in gather(["r.jsonl"]).damaged[0]


def test_what_resumed_a_run_is_told(tmp_path: Path) -> None:
    """Another machine, commit or library in a later session is noted as one of another run is."""
    path = small(tmp_path)
    config = json.loads((path / "config.json").read_text())
    config["resumed"] = [{"commit": "f" * 40, "machine": "another", "products": "onednn"}]
    config["products"] = "xla"
    (path / "config.json").write_text(json.dumps(config))
    found = compare([tmp_path])
    notes = " ".join(found.notes)
    assert "several machines" in notes
    assert "several libraries of matrix products" in notes
    assert "2 commits" in notes
    assert any("another" in line for line in contents.made_with(found))
    assert "ffffffffffff" in contents.runs(found).rows[0][6].text


def test_keywords_in_another_order_are_the_same_task(tmp_path: Path) -> None:
    small(tmp_path, seed=0, env_kwargs={"a": 1, "b": 2})
    small(tmp_path, seed=1, env_kwargs={"b": 2, "a": 1})
    assert [len(group.runs) for group in compare([tmp_path]).groups] == [2]


def test_a_schedule_that_is_cut_is_told(tmp_path: Path) -> None:
    for seed in range(3):
        small(tmp_path, seed=seed, lr_horizon=20_000, lr_end=0.1)
    assert "schedule" not in " ".join(compare([tmp_path]).notes)
    found = compare([tmp_path], budget=10_000)
    assert "Cut before their schedule" in " ".join(found.notes)
    (row,) = contrasts.best_of_two(compare([tmp_path]))[0].rows
    assert row[4].text == "-"


def test_results_are_collected_once_and_finished(tmp_path: Path) -> None:
    """Of runs of one task, name and seed in two places, none is chosen silently."""
    make_run(tmp_path / "runs", "Ant-v5", "td3", budget=200_000, evaluations=20)
    make_run(tmp_path / "runs", "Ant-v5", "sac", budget=10_000, evaluations=5, planned=20_000)
    script = (ROOT / "results" / "summary.py").read_text()
    (tmp_path / "results").mkdir()
    copy = tmp_path / "results" / "summary.py"
    copy.write_text(script)

    def collect(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(copy), "--study", "pilot", "--collect", "pilot", *words]
        return subprocess.run(command, capture_output=True, text=True)

    done = collect("runs")
    assert "left out as unfinished: runs/Ant-v5/sac/0" in done.stderr
    names = [json.loads(line)["settings"]["name"] for line in _lines(copy)]
    assert names == ["td3"]
    collect("runs", "--unfinished")
    assert len(_lines(copy)) == 2
    small(tmp_path / "runs" / "other")
    done = collect("runs")
    assert done.returncode == 1
    assert "of the same task, name and seed" in done.stderr
    assert len(_lines(copy)) == 2


def _lines(script: Path) -> list[str]:
    return script.with_name("pilot.jsonl").read_text().splitlines()


def collected(tmp_path: Path, study: str) -> dict[str, Run]:
    """The runs below `runs`, as `results/summary.py --collect` takes them in, by name."""
    (tmp_path / "results").mkdir()
    copy = tmp_path / "results" / "summary.py"
    copy.write_text((ROOT / "results" / "summary.py").read_text())
    command = [sys.executable, copy, "--study", study, "--collect", study, "runs"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    found = {run.name: run for run in gather([copy.with_name(f"{study}.jsonl")]).runs}
    assert all(name in done.stdout for name in found)
    return found


def test_one_learner_is_read_at_half_of_its_steps_too(tmp_path: Path) -> None:
    """Beside two members: for the updates of one, and for those of both."""
    settings: dict[str, Any] = {**TINY, "steps": 200, "eval_every": 50, "mean_actions": "on"}
    trainer = Trainer("td3", "Pendulum-v1", runs=tmp_path / "runs", name="single", **settings)
    run_to_end(trainer)
    found = collected(tmp_path, "ensemble")
    assert found.keys() == {"single", "single-ema", "single-half", "single-ema-half"}
    assert found["single-half"].finished
    for name in ("single", "single-ema"):
        whole, half = found[name], found[f"{name}-half"]
        assert (half.steps[-1], whole.steps[-1]) == (100, 200)
        np.testing.assert_array_equal(half.returns, whole.returns[:3])


def test_other_policies_of_a_run_are_collected_as_groups(tmp_path: Path) -> None:
    """Of a study of ensembles: members alone, their mean action and that of their EMA actors."""
    settings: dict[str, Any] = {**TINY, "steps": 200, "eval_every": 100, "members": 2}
    settings |= {"rule": "none", "mean_actions": "on", "vary": {"gamma": [0.98, 0.99]}}
    trainer = Trainer("td3", "Pendulum-v1", runs=tmp_path / "runs", name="none", **settings)
    run_to_end(trainer)
    rows = trainer.directory.rows("eval")
    assert all(row["members"][row["champion"]] == row["mean"] for row in rows)
    found = {name: run.returns for name, run in collected(tmp_path, "ensemble").items()}
    assert found.keys() == {"none", "none-members", "none-mean", "none-ema"}
    for name, means in {
        "none-members": [np.mean(row["members"]) for row in rows],
        "none-mean": [row["mean_actions"]["members"]["mean"] for row in rows],
        "none-ema": [row["mean_actions"]["ema"]["mean"] for row in rows],
    }.items():
        np.testing.assert_allclose(found[name], means, atol=1e-3)

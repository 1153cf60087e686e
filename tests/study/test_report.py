"""The report in a real browser: one file, no errors, sortable, readable narrow and by keyboard."""

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import chromium
from compare import make_run
from policies import untrained

from pacesetter.cli.main import main
from pacesetter.errors import TaskError, UsageError
from pacesetter.media.scene import INSTALL
from pacesetter.runs import RunDirectory
from pacesetter.study.compare import stats
from pacesetter.study.compare.comparison import compare
from pacesetter.study.compare.results import compact
from pacesetter.study.report import figures, films, intervals


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for env in ("HalfCheetah-v5", "Walker2d-v5"):
        for name, level in (("td3", 4_000.0), ("multi-td3", 3_000.0)):
            for seed in range(5):
                make_run(folder, env, name, seed, level=level, budget=100_000, evaluations=20)
    return folder


def write(path: Path, *words: object) -> str:
    assert main(["compare", *map(str, words), "-o", str(path)]) == 0
    return path.read_text()


@pytest.fixture(scope="module")
def page(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write(path, runs, "--published", "--no-film")
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def opened(browser: Any, page: Path) -> Any:
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.set_window_size(1280, 900)
    browser.get(page.as_uri())
    return browser


def column(browser: Any, table: int, place: int) -> list[str]:
    script = (
        "return [...document.querySelectorAll('table.sortable')[arguments[0]].tBodies[0].rows]"
        ".map(row => row.cells[arguments[1]].firstChild.textContent.trim())"
    )
    return browser.execute_script(script, table, place)


def test_page_is_one_file_that_asks_nobody(page: Path) -> None:
    text = page.read_text()
    linked = re.sub(r'<a href="https://[^"<>]+">', "<a>", text)  # followed by a click alone
    assert not re.search(r"(src|href)\s*=\s*[\"'](?!data:|#)", linked)
    assert not re.search(r"@import|url\((?!#|data:)|fetch\(|XMLHttpRequest", text)
    assert text.count("<script") == 2


def test_page_opens_with_its_result_and_its_contents(page: Path) -> None:
    """One sentence first; every entry of the contents leads somewhere; the paper comes last."""
    text = page.read_text()
    result = re.search(r'<p class="result">(.*?)</p>', text)
    assert result
    assert result[1].startswith(
        "Against td3, by the 95% interval of the difference in final return"
    )
    assert text.index(result[0]) < text.index("<nav") < text.index("<table")
    targets = re.findall(r'<li><a href="#([^"]+)">', text)
    assert len(targets) == len({*targets}) > 8
    places = [text.index(f'id="{target}"') for target in targets]
    assert places == sorted(places)
    assert targets.index("the-papers-figure-2") > targets.index("what-a-mean-run-spent")
    assert 'href="https://github.com/sfujim/TD3"' in text


def test_a_figure_of_the_paper_without_its_pair_is_left_out(runs: Path, tmp_path: Path) -> None:
    """Of two tasks of three, and no sunrise: two of six panels, and none is empty."""
    text = write(tmp_path / "a.html", runs, "--no-film")
    start = text.index('id="the-papers-figure-2"')
    assert text[start : text.index("</section>", start)].count('<g id="axes_') == 2
    assert "no runs" not in text
    alone = write(tmp_path / "b.html", runs / "Walker2d-v5" / "td3", "--no-film")
    assert "figure 2" not in alone


def test_intervals_stand_where_the_numbers_are(runs: Path) -> None:
    """Places in percent of the track give back means, intervals and seeds."""
    found = compare([runs / "Walker2d-v5"])
    (track,) = intervals.tracks(found)
    assert [bar.name for bar in track.bars] == ["td3", "multi-td3"]
    group, bar = found.groups[1], track.bars[0]
    assert (group.name, group.env) == ("td3", track.env)
    mean, seeds = stats.mean(group.values("final")), group.values("final")
    per_percent = (seeds.max() - seeds.min()) / (max(bar.seeds) - min(bar.seeds))
    base = seeds[0] - per_percent * bar.seeds[0]
    assert bar.left is not None
    shown = [base + per_percent * at for at in (bar.dot, bar.left, bar.left + bar.width)]
    np.testing.assert_allclose(shown, mean, rtol=2e-3)
    assert min(one.left or 0 for one in track.bars) > 0
    assert max((one.left or 0) + one.width for one in track.bars) < 100


def test_a_narrow_page_keeps_the_first_column_and_shadows_the_rest(opened: Any) -> None:
    size = {"width": 390, "height": 900, "deviceScaleFactor": 1, "mobile": True}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    opened.refresh()
    look = """
        const inner = document.querySelector('#each-group .scroll'), box = inner.parentElement;
        inner.scrollLeft = arguments[0];
        await new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
        const cell = inner.querySelector('tbody td').getBoundingClientRect();
        return [box.classList.contains('more'), Math.round(cell.left), cell.width > 80,
                getComputedStyle(inner.querySelector('td.number')).textAlign];
    """
    script = "return (async (...arguments) => {" + look + "})(...arguments)"
    first = opened.execute_script(script, 0)
    last = opened.execute_script(script, 10_000)
    assert first[0] is True
    assert last[0] is False
    assert first[1:] == [first[1], True, "right"] == last[1:]


def test_a_dark_scheme_is_dark(opened: Any) -> None:
    """Text and lines stand out from the ground of either scheme."""
    brightness = """
        const sum = (text) => text.match(/\\d+/g).slice(0, 3).reduce((a, b) => a + Number(b), 0);
        const of = (name, style) => sum(getComputedStyle(document.querySelector(name))[style]);
        return [of('body', 'backgroundColor'), of('body', 'color'),
                of('thead th', 'backgroundColor'), of('td:first-child', 'backgroundColor')];
    """
    found: dict[str, list[int]] = {}
    for scheme in ("light", "dark"):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        found[scheme] = opened.execute_script(brightness)
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    ground, ink, *cells = found["light"]
    assert min(ground, *cells) > 700 > 150 > ink
    ground, ink, *cells = found["dark"]
    assert max(ground, *cells) < 150 < 600 < ink


def test_page_opens_without_errors_or_requests(opened: Any) -> None:
    assert opened.get_log("browser") == []
    loaded = "return performance.getEntriesByType('resource').map(entry => entry.name)"
    assert [name for name in opened.execute_script(loaded) if not name.startswith("data:")] == []
    charts = "return document.querySelectorAll('.chart').length"
    assert opened.execute_script(charts) == 3  # two tasks and the profile


def test_tables_sort_by_number_and_back(opened: Any) -> None:
    header = "return [...document.querySelectorAll('table.sortable')].findIndex("
    header += "table => table.tHead.textContent.includes('SD over seeds'))"
    table = opened.execute_script(header)
    button = opened.execute_script(
        "return document.querySelectorAll('table.sortable')[arguments[0]]"
        ".querySelectorAll('th button')[3]",
        table,
    )
    for way, reverse in (("ascending", False), ("descending", True)):
        opened.execute_script("arguments[0].click()", button)
        finals = [float(t.split(" ")[0].replace(",", "")) for t in column(opened, table, 3)]
        assert finals == sorted(finals, reverse=reverse)
        state = "return arguments[0].parentElement.getAttribute('aria-sort')"
        assert opened.execute_script(state, button) == way


def test_algorithms_and_axes_are_switched(opened: Any) -> None:
    lines = "return document.querySelectorAll('.chart')[0].querySelectorAll('path[fill=none]')"
    assert len(opened.execute_script(lines)) == 2
    boxes = opened.find_elements("css selector", "#names input")
    boxes[0].click()
    assert len(opened.execute_script(lines)) == 1
    boxes[0].click()
    boxes[-1].click()  # each seed
    assert len(opened.execute_script(lines)) == 2 + 10
    opened.find_elements("css selector", "#axes input")[1].click()
    words = "return document.querySelectorAll('.chart')[0].querySelector('svg').textContent"
    assert "gradient updates" in opened.execute_script(words)


def test_a_chart_is_read_by_mouse_and_by_keyboard(opened: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    chart = opened.find_element("css selector", ".chart svg")
    values = opened.find_element("css selector", ".chart .values")
    ActionChains(opened).move_to_element(chart).perform()
    assert re.search(r"env steps.*td3 \d+ \[.*multi-td3 \d+ \[", values.text, re.S)
    ActionChains(opened).move_by_offset(0, -400).perform()
    opened.execute_script("arguments[0].focus()", chart)
    chart.send_keys(Keys.ARROW_RIGHT)
    assert "env steps, all members 0" in values.text
    chart.send_keys(Keys.ARROW_RIGHT)
    assert "env steps, all members 2500" in values.text
    outline = "return getComputedStyle(arguments[0]).outlineStyle"
    assert opened.execute_script(outline, chart) == "solid"


def test_the_interval_of_two_seeds_does_not_flatten_the_curves(
    browser: Any, tmp_path: Path
) -> None:
    """Student's t with one degree of freedom is 12.7; of its band the means' height is shown."""
    for seed, level in enumerate((1_000.0, 3_000.0)):
        make_run(tmp_path, "Ant-v5", "td3", seed, level=level, budget=100_000, evaluations=20)
    found = compare([tmp_path])
    panel = figures.page(found, "steps").axes[0]
    (line,) = panel.lines
    means, (low, high) = line.get_ydata(), panel.get_ylim()
    height = means.max() - means.min()
    assert stats.mean(np.array([1_000.0, 3_000.0])).high > means.max() + 2 * height
    assert low >= means.min() - height
    assert high == pytest.approx(means.max() + height)
    write(tmp_path / "report.html", tmp_path, "--no-film")
    browser.get((tmp_path / "report.html").as_uri())
    script = "return document.querySelector(arguments[0]).getBBox().height"
    band, mean = (
        browser.execute_script(script, f"figure.chart {part}")
        for part in ("svg.panel path", "path[fill=none]")
    )
    panel = "return document.querySelector('svg.panel').height.baseVal.value"
    plot = browser.execute_script(panel)
    assert band > 2 * plot, "the rest is cut"
    assert plot > mean > plot / 4


def test_every_control_is_reached_by_tab(opened: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    reached: set[str] = set()
    for _ in range(90):
        opened.switch_to.active_element.send_keys(Keys.TAB)
        reached.add(opened.execute_script("return document.activeElement.localName"))
    assert {"a", "button", "input", "svg", "div", "summary"} <= reached


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_overflows_the_page(opened: Any, width: int) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    opened.refresh()
    assert opened.execute_script("return document.documentElement.scrollWidth") == width
    outside = """
        const clipped = [];
        for (const svg of document.querySelectorAll('.chart svg')) {
            const box = svg.getBoundingClientRect();
            for (const text of svg.querySelectorAll('text')) {
                const one = text.getBoundingClientRect();
                if (one.left < box.left - 1 || one.right > box.right + 1
                    || one.bottom > box.bottom + 1) clipped.push(text.textContent);
            }
        }
        return clipped;
    """
    assert opened.execute_script(outside) == []
    smallest = """
        return Math.min(...[...document.querySelectorAll('.chart text, td, p, label, th')]
            .map(one => parseFloat(getComputedStyle(one).fontSize)));
    """
    assert opened.execute_script(smallest) >= 12


def test_words_from_runs_are_shown_as_words(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs", budget=20_000, evaluations=10)
    config = json.loads((run / "config.json").read_text())
    evil = "</script><script>alert(1)</script>"
    config["settings"]["env_kwargs"] = {"xml_file": evil}
    config["command"] = evil
    (run / "config.json").write_text(json.dumps(config))
    text = write(tmp_path / "report.html", run, "--no-film")
    assert evil not in text
    assert "\\u003c/script>" in text
    assert "&lt;/script&gt;" in text


def test_the_champions_film_is_in_the_page(runs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(runs, tmp_path / "runs")
    for run in folder.rglob("config.json"):
        env = run.parent.parent.parent.name
        untrained(env, step=100_000).save(run.parent / "policy.safetensors")
    whole = films.FILM_FRAMES, films.FILM_SIZE
    try:
        films.FILM_FRAMES, films.FILM_SIZE = 3, (32, 32)
        text = write(tmp_path / "report.html", folder)
    finally:
        films.FILM_FRAMES, films.FILM_SIZE = whole
    if INSTALL in text:
        pytest.skip("no OpenGL to draw with; the page says so")
    assert text.count("data:video/mp4;base64,AAAA") == 2
    assert "the policy of step 100,000" in text


def test_a_film_of_a_wrapped_task_is_made_if_it_is_allowed(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[Any] = []
    monkeypatch.setattr(
        "pacesetter.media.record.record",
        lambda policy, path, env, **how: (played.append(env), path.write_bytes(b"x")),
    )
    run = shutil.copytree(runs / "Walker2d-v5", tmp_path / "runs" / "Walker2d-v5")
    wrap = ["wrapper_that_nobody_imports:Half"]
    for config in run.rglob("config.json"):
        untrained("Walker2d-v5", wrap=wrap).save(config.parent / "policy.safetensors")
    assert "allow it with --allow" in write(tmp_path / "a.html", tmp_path / "runs")
    text = write(tmp_path / "b.html", tmp_path / "runs", "--allow", wrap[0])
    assert "<video" in text
    assert [env.wrap for env in played] == [tuple(wrap)]


@pytest.mark.parametrize("kind", [UsageError, TaskError])
def test_a_page_without_a_film_says_why_in_one_line(
    kind: type[Exception], runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*words: Any, **more: Any) -> int:
        raise kind(f"video: no OpenGL to draw with; {INSTALL}")

    run = shutil.copytree(runs / "Walker2d-v5", tmp_path / "runs" / "Walker2d-v5")
    for config in run.rglob("config.json"):
        untrained("Walker2d-v5").save(config.parent / "policy.safetensors")
    monkeypatch.setattr("pacesetter.media.record.record", refuse)
    text = write(tmp_path / "a.html", tmp_path / "runs")
    assert f"no film: video: no OpenGL to draw with; {INSTALL}" in text
    assert "<video" not in text
    file = tmp_path / "results.jsonl"
    lines = [compact(RunDirectory(config.parent)) for config in run.rglob("config.json")]
    file.write_text("".join(json.dumps(line) + os.linesep for line in lines))
    assert "no film, since results hold no policy" in write(tmp_path / "b.html", file)


def test_one_short_run_without_an_update_is_drawn(browser: Any, tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    run = make_run(tmp_path / "runs", budget=20_000, evaluations=10)
    write(tmp_path / "report.html", run, "--no-film")
    browser.get((tmp_path / "report.html").as_uri())
    for axis in browser.find_elements("css selector", "#axes input"):
        axis.click()
        chart = browser.find_element("css selector", ".chart svg")
        browser.execute_script("arguments[0].focus()", chart)
        chart.send_keys(Keys.ARROW_RIGHT)
        assert "NaN" not in browser.find_element("css selector", ".chart").get_property("outerHTML")
    assert browser.get_log("browser") == []


def test_words_leave_as_words_of_other_programs(tmp_path: Path) -> None:
    """Keywords of a task may hold anything; a table, a comment or a terminal must not."""
    run = make_run(tmp_path / "runs", budget=20_000, evaluations=10)
    config = json.loads((run / "config.json").read_text())
    evil = "a\n\\input{/etc/passwd}\x1b[31m|b|<i>[x](y)$\\z$"
    config["settings"]["env_kwargs"] = {"xml_file": evil}
    (run / "config.json").write_text(json.dumps(config))
    tex = write(tmp_path / "a.tex", run)
    page = write(tmp_path / "a.md", run)
    write(tmp_path / "a.svg", run)
    for text in (tex, page):
        assert "\x1b" not in text
        assert not any(line.startswith("\\input") for line in text.splitlines())
    code = "\n".join(line for line in tex.splitlines() if not line.startswith("%"))
    assert "\\input" not in code
    assert "<i>" not in page
    assert "[x](y)" not in page

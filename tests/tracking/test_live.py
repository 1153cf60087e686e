"""`live`: the page shows what the log says, grows with it, and is for this machine alone."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from browsers import chromium
from compare import make_run
from selenium.webdriver.common.action_chains import ActionChains

from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory
from pacesetter.tracking.live import MOST_EPISODES, PAGE, curve, curves, serving

EVALUATIONS = 4


LEDGER = {"updates": 1_900, "wall_seconds": 40.0}


@pytest.fixture
def run(runs: Path) -> RunDirectory:
    """Four evaluations and a row of training, of a run that has made half its budget."""
    run = evaluated(make_run(runs, budget=2_000, planned=4_000, evaluations=10), EVALUATIONS)
    ended = [[0, 100.0, 10], [0, 300.0, 10]]
    run.log.append({"kind": "train", "step": 2_000, "episodes_ended": ended} | LEDGER)
    return run


def evaluated(path: Path, count: int) -> RunDirectory:
    """The run there with so many evaluations as its log."""
    run = RunDirectory(path)
    run.metrics_file.unlink()
    for step in range(0, 500 * count, 500):
        returns = [step - 10.0, step + 30.0]
        run.log.append(
            {"kind": "eval", "step": step, "returns": returns, "mean": step + 10.0} | LEDGER
        )
    return run


@pytest.fixture
def port(run: RunDirectory) -> Iterator[int]:
    with page_of([run]) as found:
        yield found


@contextmanager
def page_of(runs: list[RunDirectory]) -> Iterator[int]:
    """The port of their page."""
    with serving(lambda: runs) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def get(port: int, path: str, host: str | None = None) -> tuple[int, str]:
    connection = HTTPConnection("127.0.0.1", port)
    connection.request("GET", path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_the_curve_is_that_of_the_log(run: RunDirectory, port: int) -> None:
    status, text = get(port, "/curves.json")
    (found,) = json.loads(text)
    assert status == 200
    assert found == curve(run)
    assert found["name"] == str(run.path)
    assert found["evaluations"][:2] == [[0, 10.0, -10.0, 30.0], [500, 510.0, 490.0, 530.0]]
    assert len(found["evaluations"]) == EVALUATIONS
    assert found["episodes"] == [[2_000, 0, 100.0], [2_000, 0, 300.0]]
    assert (found["budget"], found["updates"]) == (4_000, 1_900)
    assert found["title"] == "HalfCheetah-v5, td3, seed 0"


def test_a_row_that_is_being_written_is_left_out(run: RunDirectory, port: int) -> None:
    before = get(port, "/curves.json")
    line = json.dumps(run.rows()[0] | {"step": 3_000})
    with run.metrics_file.open("a") as file:
        file.write(line[:40])
    assert get(port, "/curves.json") == before
    with run.metrics_file.open("a") as file:
        file.write(line[40:] + "\n")
    assert json.loads(get(port, "/curves.json")[1])[0]["evaluations"][-1][0] == 3_000


def test_a_return_that_is_no_number_is_left_out(run: RunDirectory) -> None:
    """As of a task that pays an infinite reward."""
    run.log.append(run.rows("eval")[0] | {"mean": None, "returns": [1.0, None]})
    assert len(curve(run)["evaluations"]) == EVALUATIONS


def test_a_long_run_is_thinned(run: RunDirectory) -> None:
    """Evenly, so that a browser can draw it."""
    ended = [[0, float(index), 10] for index in range(2 * MOST_EPISODES)]
    run.log.append({"kind": "train", "step": 3_000, "episodes_ended": ended} | LEDGER)
    found = curve(run)["episodes"]
    assert MOST_EPISODES / 2 < len(found) <= MOST_EPISODES
    assert found[-1][2] > 1.9 * MOST_EPISODES


def test_an_empty_or_damaged_log_ends_no_server(run: RunDirectory, port: int) -> None:
    run.metrics_file.write_text("{broken}\n")
    status, text = get(port, "/curves.json")
    assert status == 500
    assert "damaged" in text
    run.metrics_file.unlink()
    assert json.loads(get(port, "/curves.json")[1])[0]["evaluations"] == []


def test_only_this_machine_and_only_this_page(port: int) -> None:
    """A page of another site cannot read it through a name that it lets lead here."""
    assert get(port, "/")[0] == 200
    assert get(port, "/", f"localhost:{port}")[0] == 200
    assert get(port, "/curves.json", f"evil.example:{port}")[0] == 403
    assert get(port, "/../config.json")[0] == 404


def test_the_page_asks_no_network(port: int) -> None:
    text = get(port, "/")[1]
    assert "http:" not in text
    assert "https:" not in text
    assert "src=" not in text


@pytest.fixture
def several(run: RunDirectory, runs: Path) -> list[RunDirectory]:
    """The run, another seed of it, and one whose log is damaged."""
    other = evaluated(make_run(runs, seed=1, budget=3_000, evaluations=3), 3)
    broken = RunDirectory(make_run(runs, name="sac", budget=2_000, evaluations=2))
    broken.metrics_file.write_text("{broken}\n")
    return [broken, run, other]


def test_several_runs(several: list[RunDirectory]) -> None:
    """Each by the name of `list runs`; a damaged one is told and does not hide the others."""
    broken, *good = several
    first, *found = curves(several)
    assert found == [curve(run) for run in good]
    assert [len(each["evaluations"]) for each in found] == [EVALUATIONS, 3]
    assert first["name"] == str(broken.path)
    assert "damaged" in first["fault"]
    with pytest.raises(UsageError, match="damaged"):
        curves([broken])


def test_episodes_are_shared_out(run: RunDirectory, several: list[RunDirectory]) -> None:
    """The page of many runs is no larger than that of one."""
    ended = [[0, float(index), 10] for index in range(2 * MOST_EPISODES)]
    run.log.append({"kind": "train", "step": 3_000, "episodes_ended": ended} | LEDGER)
    found = {each["name"]: each for each in curves(several)}[str(run.path)]["episodes"]
    assert MOST_EPISODES / 6 < len(found) <= MOST_EPISODES / 3


def test_a_log_is_read_again_only_if_it_grew(
    run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But a state that is not in the log is always the one of now."""
    before = curve(run)
    read: list[Path] = []
    rows = RunDirectory.rows
    monkeypatch.setattr(RunDirectory, "rows", lambda self: (read.append(self.path), rows(self))[1])
    run.lock()
    assert curve(run) == before | {"is_running": True}
    assert read == []
    run.log.append(run.log.rows("eval")[0] | {"step": 3_000})
    assert len(curve(run)["evaluations"]) == EVALUATIONS + 1
    assert read == [run.path]
    run.unlock()


def test_a_folder_and_the_runs_that_start_later(
    several: list[RunDirectory], runs: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder is looked at anew each time, and names that name a run twice show it once."""
    looks: list[list[str]] = []

    @contextmanager
    def look(find: Any, port: int) -> Iterator[Any]:
        looks.append([each["name"] for each in curves(find())])
        evaluated(make_run(runs, "Ant-v5", budget=1_000, evaluations=1), 1)
        looks.append([each["name"] for each in curves(find())])
        yield SimpleNamespace(server_port=1, serve_forever=lambda: None)

    monkeypatch.setattr("pacesetter.tracking.live.serving", look)
    words = [str(runs), "HalfCheetah-v5/td3", str(several[1].path)]
    assert main(["live", *words, "--runs", str(runs)]) == 0
    names = [str(run.path) for run in several]
    assert looks == [names, [f"{runs}/Ant-v5/td3/0", *names]]
    told = capsys.readouterr()
    assert "shows 3 runs; Ctrl-C ends it" in told.out
    assert told.err.startswith("pacesetter: left out: ")
    assert "damaged" in told.err


def test_bad_input(runs: Path, run: RunDirectory, port: int, capsys: Any) -> None:
    assert main(["live", "nothing", "--runs", str(runs)]) == 2
    assert "not found" in capsys.readouterr().err
    for taken in (port, 99_999):
        assert main(["live", str(run.path), "--port", str(taken)]) == 2
        assert f"port: cannot use {taken}" in capsys.readouterr().err


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_a_signal_is_its_end(run: RunDirectory, sent: signal.Signals, code: int) -> None:
    command = [sys.executable, "-m", "pacesetter", "live", str(run.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout
        line = process.stdout.readline().decode()
        process.send_signal(sent)
        assert process.wait(10) == code
        assert process.stderr
        assert process.stderr.read() == b""
    assert line.startswith("http://127.0.0.1:")
    assert str(run.path) in line


@pytest.mark.slow
def test_the_page_draws_and_refreshes(run: RunDirectory, port: int, tmp_path: Path) -> None:
    """In a browser: dark, narrow, without an error, and a new row appears by itself."""
    with chromium(tmp_path / "profile") as browser:
        scheme = {"name": "prefers-color-scheme", "value": "dark"}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
        narrow = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", narrow)
        browser.get(f"http://127.0.0.1:{port}/")
        wait_for(browser, "document.querySelectorAll('.point').length", EVALUATIONS)
        wait_for(browser, "document.querySelectorAll('.episode').length", 2)
        assert browser.execute_script("return document.documentElement.scrollWidth") == 360
        paper = "return getComputedStyle(document.body).backgroundColor"
        assert browser.execute_script(paper) == "rgb(23, 25, 28)"
        run.log.append(run.rows("eval")[-1] | {"step": 2_500, "mean": 1234.5})
        wait_for(browser, "document.querySelectorAll('.point').length", EVALUATIONS + 1)
        assert browser.find_element("id", "last").text == "1,234.5"
        assert browser.get_log("browser") == []


@pytest.mark.slow
def test_the_page_of_several_runs(several: list[RunDirectory], tmp_path: Path) -> None:
    """In a browser: a curve and an entry each; the numbers are of the chosen one."""
    with page_of(several) as port, chromium(tmp_path / "profile") as browser:
        narrow = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", narrow)
        browser.get(f"http://127.0.0.1:{port}/")
        wait_for(browser, "document.querySelectorAll('g[data-run]').length", 2)
        assert browser.execute_script("return document.documentElement.scrollWidth") == 360
        broken, first, second = browser.find_elements("css selector", "#runs button")
        for button, run in zip((broken, first, second), several, strict=True):
            assert button.find_element("tag name", "span").text == str(run.path)
        assert not broken.is_enabled()
        assert browser.find_element("id", "last").text == "1,510"
        colour = "return getComputedStyle(document.querySelectorAll('g .line')[{}]).stroke"
        assert len({browser.execute_script(colour.format(place)) for place in (0, 1)}) == 2
        second.click()
        chosen = curve(several[2])["evaluations"][-1][1]
        wait_for(browser, "document.querySelector('g.picked').dataset.run", str(several[2].path))
        assert browser.find_element("id", "picked").text == str(several[2].path)
        assert float(browser.find_element("id", "last").text.replace(",", "")) == pytest.approx(
            chosen, abs=0.05
        )
        ActionChains(browser).move_to_element(first).perform()
        wait_for(browser, "document.querySelector('g.lit')?.dataset.run", str(several[1].path))
        assert browser.get_log("browser") == []


def wait_for(browser: Any, expression: str, value: Any) -> None:
    end = time.monotonic() + 30
    while browser.execute_script(f"return {expression}") != value:
        assert time.monotonic() < end, browser.execute_script(f"return {expression}")
        time.sleep(0.1)


def test_only_evaluations_are_drawn(run: RunDirectory) -> None:
    """A row of another kind may hold anything, words that a page would run included."""
    words = "<img src=x onerror=alert(1)>"
    run.log.append({"kind": "note", "step": 2_001, "mean": words, "returns": [1.0]} | LEDGER)
    assert "onerror" not in json.dumps(curve(run))
    assert "Number(value).toLocaleString" in PAGE.read_text()


def test_a_run_that_met_its_goal_is_over(runs: Path) -> None:
    met = make_run(runs, budget=2_000, planned=4_000, evaluations=4, name="met", stop_at=0.0)
    for path, over in ((met, True), (make_run(runs, budget=2_000, planned=4_000), False)):
        assert curve(evaluated(path, EVALUATIONS))["is_over"] is over


def test_a_closed_tab_is_no_news(run: RunDirectory, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(lambda: [run]) as server:
        for error in (BrokenPipeError(), ConnectionResetError()):
            try:
                raise error
            except OSError:
                server.handle_error(None, ("127.0.0.1", 1))
        assert capsys.readouterr().err == ""
        try:
            raise KeyError("mean")
        except KeyError:
            server.handle_error(None, ("127.0.0.1", 1))
        assert "KeyError: 'mean'" in capsys.readouterr().err

"""A page on this machine with the curves of runs, read off their logs as they grow."""

import json
import sys
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.runs import Row, RunDirectory
from pacesetter.settings.budget import Standing, budget, is_spent, standing
from pacesetter.storage import FAULTS

Runs = Callable[[], Iterable[RunDirectory]]  # asked at each look, so that new runs join

ADDRESS = "127.0.0.1"
PAGE = Path(__file__).with_name("live.html")
MOST_EPISODES = 3_000  # of all runs, which a browser gets at once
KEPT = 256  # logs that have not grown since they were read, and are not read again
# The page may ask this server alone, and no page of another site may ask for it.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'",
    "Cache-Control": "no-cache",
    "X-Content-Type-Options": "nosniff",
}


def curves(runs: Iterable[RunDirectory]) -> list[Row]:
    """What the page draws: each run's curve, or its name and fault if it cannot be read.

    Raises UsageError if none can.
    """
    every = list(runs)
    found = [_curve_or_fault(run, MOST_EPISODES // len(every)) for run in every]
    if found and all("fault" in each for each in found):
        raise UsageError(found[0]["fault"])
    return found


def _curve_or_fault(run: RunDirectory, most: int) -> Row:
    try:
        return curve(run, most)
    except UsageError as error:
        return {"name": str(run.path), "fault": str(error)}
    except FAULTS as error:
        return {"name": str(run.path), "fault": f"{run.path}: damaged: {error}"}


def curve(run: RunDirectory, most: int = MOST_EPISODES) -> Row:
    """Steps and returns of a run's evaluations, and of at most so many training episodes."""
    settings = run.settings()
    logged, now = _logged(run.path, _size(run.metrics_file), most)
    step, seconds = logged["spent"][-1] if logged["spent"] else (0, 0.0)
    return {
        "name": str(run.path),
        "title": f"{settings['env']}, {settings['name']}, seed {settings['seed']}",
        "budget": budget(settings),
        "is_running": run.in_use(),
        "is_over": is_spent(settings, step, seconds, now),
        **logged,
    }


def _size(file: Path) -> tuple[int, int] | None:
    """What changes when a file does."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


@lru_cache(KEPT)
def _logged(run: Path, size: tuple[int, int] | None, most: int) -> tuple[Row, Standing]:
    """The part of a curve that comes from the log, whose size says whether it has grown, and how
    its evaluations stand.
    """
    rows = RunDirectory(run).rows()
    evaluated = [row for row in rows if row["kind"] == "eval" and row["mean"] is not None]
    curve = {
        "evaluations": [_evaluation(row) for row in evaluated],
        "episodes": _episodes(rows, most),
        "spent": [[row["step"], row["wall_seconds"]] for row in rows[-20:]],
        "updates": rows[-1]["updates"] if rows else 0,
    }
    return curve, standing((row["step"], row["mean"], row["updates"]) for row in evaluated)


def _evaluation(row: Row) -> list[float]:
    return [row["step"], row["mean"], min(row["returns"]), max(row["returns"])]


def _episodes(rows: list[Row], most: int) -> list[list[float]]:
    """Step of the row, member and return of the episodes; evenly spaced ones if they are many."""
    found = [(row["step"], each) for row in rows for each in row.get("episodes_ended", [])]
    every = -(-len(found) // max(most, 1)) or 1
    return [[step, member, total] for step, (member, total, _) in found[::every]]


@contextmanager
def serving(runs: Runs, port: int = 0) -> Generator[ThreadingHTTPServer]:
    """A server of the page, for `serve_forever`; port 0 is any free one. Only this machine sees it.

    Raises UsageError if the port is taken.
    """

    class Handler(_Handler):
        find = staticmethod(runs)

    try:
        server = _Server((ADDRESS, port), Handler)
        Handler.hosts = tuple(f"{name}:{server.server_port}" for name in (ADDRESS, "localhost"))
    except (OSError, OverflowError) as error:
        raise UsageError(f"port: cannot use {port}: {error}; give another, or none") from None
    with server:
        yield server


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a tab that was closed before its answer; all else is a fault of ours."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    find: Runs
    hosts: tuple[str, ...]

    def do_GET(self) -> None:
        """The page, or the curves as they are now."""
        if self.headers.get("Host") not in self.hosts:
            self.send_error(HTTPStatus.FORBIDDEN)  # a name of another site that leads here
        elif self.path == "/":
            self._send("text/html; charset=utf-8", PAGE.read_bytes())
        elif self.path == "/curves.json":
            self._send_curves()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_curves(self) -> None:
        try:
            text = json.dumps(curves(self.find()))
        except UsageError as error:
            # Escaped, since a folder may be named by any character, and this goes into a header.
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, ascii(str(error))[1:-1])
            return
        self._send("application/json", text.encode())

    def _send(self, kind: str, data: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in (HEADERS | {"Content-Type": kind, "Content-Length": len(data)}).items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: a page asks every two seconds."""

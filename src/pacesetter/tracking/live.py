"""A page on this machine with the curve of a run, read off its log as it grows."""

import json
from collections.abc import Generator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.runs import Row, RunDirectory
from pacesetter.settings.budget import budget

ADDRESS = "127.0.0.1"
PAGE = Path(__file__).with_name("live.html")
MOST_EPISODES = 3_000  # dots that a browser draws at once
# The page may ask this server alone, and no page of another site may ask for it.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'",
    "Cache-Control": "no-cache",
    "X-Content-Type-Options": "nosniff",
}


def curve(run: RunDirectory) -> dict[str, Any]:
    """What the page draws: steps and returns of evaluations, and of training episodes."""
    rows, settings = run.rows(), run.settings()
    return {
        "title": f"{settings['env']}, {settings['name']}, seed {settings['seed']}",
        "budget": budget(settings),
        "is_running": run.in_use(),
        "evaluations": [_evaluation(row) for row in rows if row.get("mean") is not None],
        "episodes": _episodes(rows),
        "spent": [[row["step"], row["wall_seconds"]] for row in rows[-20:]],
        "updates": rows[-1]["updates"] if rows else 0,
    }


def _evaluation(row: Row) -> list[float]:
    return [row["step"], row["mean"], min(row["returns"]), max(row["returns"])]


def _episodes(rows: list[Row]) -> list[list[float]]:
    """Step of the row, member and return of the episodes; evenly spaced ones if they are many."""
    found = [(row["step"], each) for row in rows for each in row.get("episodes_ended", [])]
    every = -(-len(found) // MOST_EPISODES) or 1
    return [[step, member, total] for step, (member, total, _) in found[::every]]


@contextmanager
def serving(run: RunDirectory, port: int = 0) -> Generator[ThreadingHTTPServer]:
    """A server of the page, for `serve_forever`; port 0 is any free one. Only this machine sees it.

    Raises UsageError if the port is taken.
    """

    class Handler(_Handler):
        directory = run

    try:
        server = ThreadingHTTPServer((ADDRESS, port), Handler)
        Handler.hosts = tuple(f"{name}:{server.server_port}" for name in (ADDRESS, "localhost"))
    except (OSError, OverflowError) as error:
        raise UsageError(f"port: cannot use {port}: {error}; give another, or none") from None
    with server:
        yield server


class _Handler(BaseHTTPRequestHandler):
    directory: RunDirectory
    hosts: tuple[str, ...]

    def do_GET(self) -> None:
        """The page, or the curve as it is now."""
        if self.headers.get("Host") not in self.hosts:
            self.send_error(HTTPStatus.FORBIDDEN)  # a name of another site that leads here
        elif self.path == "/":
            self._send("text/html; charset=utf-8", PAGE.read_bytes())
        elif self.path == "/curve.json":
            self._send_curve()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_curve(self) -> None:
        try:
            text = json.dumps(curve(self.directory))
        except (UsageError, KeyError, TypeError, ValueError) as error:
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, f"the log is damaged: {error}")
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

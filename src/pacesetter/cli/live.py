"""The verb `live`."""

import signal

from pacesetter.cli.flags import parser
from pacesetter.runs import find


def live(words: list[str]) -> int:
    """Show a run's curve in a browser while it trains."""
    command = parser("live", "Serve a page with a run's curve, for a browser of this machine.")
    command.add_argument("run", metavar="RUN", help="run folder, or the end of its path")
    about = "port of the page (default any free one)"
    command.add_argument("--port", type=int, default=0, metavar="N", help=about)
    command.add_runs()
    command.epilog = "The page reads metrics.jsonl every two seconds. Ctrl-C ends it."
    found = command.parse(words)
    from pacesetter.tracking.live import serving

    run = find(found.run, found.runs)
    run.record()  # damaged ones are refused here, not in the browser
    try:
        with serving(run, found.port) as server:
            page = f"http://127.0.0.1:{server.server_port}"
            print(f"{page} shows {run.path}; Ctrl-C ends it", flush=True)
            server.serve_forever()
    except KeyboardInterrupt as end:  # which is how it is meant to end
        if end.args not in ((), (signal.SIGINT,)):
            raise
    return 0

"""The verb `live`."""

import signal

from pacesetter.cli.flags import parser
from pacesetter.errors import tell
from pacesetter.runs import RunDirectory, find_each


def live(words: list[str]) -> int:
    """Show curves of runs in a browser while they train."""
    command = parser("live", "Serve a page with the curves of runs, for a browser of this machine.")
    several = "run folders, folders of runs, ends of their paths or patterns"
    command.add_argument("run", nargs="+", metavar="RUN", help=several)
    about = "port of the page (default any free one)"
    command.add_argument("--port", type=int, default=0, metavar="N", help=about)
    command.add_runs()
    command.epilog = (
        "The page reads each metrics.jsonl every two seconds, and runs that start later join it. "
        "Ctrl-C ends it."
    )
    found = command.parse(words)
    from pacesetter.tracking.live import curves, serving

    def named() -> list[RunDirectory]:
        every = [run for word in found.run for run in find_each(word, found.runs)]
        return list({run.path.resolve(): run for run in every}.values())

    runs = named()
    for each in curves(runs):  # damaged ones are told here, not only in the browser
        if "fault" in each:
            tell(f"left out: {each['fault']}")
    try:
        with serving(named, found.port) as server:
            page = f"http://127.0.0.1:{server.server_port}"
            shown = runs[0].path if len(runs) == 1 else f"{len(runs)} runs"
            print(f"{page} shows {shown}; Ctrl-C ends it", flush=True)
            server.serve_forever()
    except KeyboardInterrupt as end:  # which is how it is meant to end
        if end.args not in ((), (signal.SIGINT,)):
            raise
    return 0

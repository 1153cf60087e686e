"""The verb `compare`."""

from pacesetter.cli.flags import Parser, parser
from pacesetter.errors import tell


def compare(words: list[str]) -> int:
    """Compare runs: statistics, tables, curves, a report."""
    found = _parser().parse(words)
    from pacesetter.study.compare.comparison import compare
    from pacesetter.study.report import output

    options = output.Options(
        found.published, found.smooth, found.axis, not found.no_film, tuple(found.allow)
    )
    paths = output.check(found.o, options)
    comparison = compare(
        found.run,
        below=found.runs,
        metric=found.metric,
        budget=found.budget,
        cpu=found.cpu,
        reference=found.reference,
        mixed=found.mixed,
    )
    for why in comparison.damaged:
        tell(f"left out: {why}")
    for path in paths:
        output.write(comparison, path, options)
        print(path)
    if not paths:
        print(output.text(comparison, options))
    return 0


def _parser() -> Parser:
    command = parser("compare", "Compare runs, grouped by env and name.")
    add = command.add_argument
    runs = "run folders, ends of their paths or patterns, or .jsonl results"
    add("run", nargs="+", metavar="RUN", help=runs)
    metrics = "what to compare: final, auc or max return (default final)"
    add("--metric", default="final", metavar="X", help=metrics)
    add("--budget", metavar="N", help="count each run only up to N env steps")
    add("--cpu", metavar="T", help="count each run only up to this CPU time, such as 10m")
    reference = "name of the runs that the others are compared with (default td3)"
    add("--reference", default="td3", metavar="NAME", help=reference)
    add("--published", action="store_true", help="add published returns of other implementations")
    mixed = "compare different env versions, budgets or settings, and say so"
    add("--mixed", action="store_true", help=mixed)
    smooth = "smooth curves over N evaluations, an odd number of at least 5 (default no smoothing)"
    add("--smooth", type=int, metavar="N", help=smooth)
    axis = "draw the curves of a .png or .svg against steps, updates, cpu or wall (default steps)"
    add("--axis", metavar="X", help=axis)
    add("--no-film", action="store_true", help="leave the video out of the report")
    output = (
        "write a .html report, .md or .tex tables, .csv or .json numbers, or .png, .svg or .pdf "
        "curves and intervals; may be repeated"
    )
    add("-o", action="append", default=[], metavar="FILE", help=output)
    command.add_allow()
    command.add_runs()
    return command

"""What to run: entries x envs x seeds of a suite file, or of flags, as one checked job per run."""

import json
from collections.abc import Collection, Iterable
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

from pacesetter.config import Config, full_id, merge, resolve
from pacesetter.consent import require, require_all
from pacesetter.errors import UsageError, unknown
from pacesetter.runs import WITHOUT_RESULT, RunDirectory
from pacesetter.settings import Settings
from pacesetter.settings.files import read_file

FOLDER = Path(__file__).with_name("suites")
MOST_SEEDS = 1_000  # of one entry, so that a slip of the pen is no list of a million runs
TUNING_SEEDS = 2**31  # seeds of `tune` start here and seeds of `bench` end here, so none is both
DECIDED = ("algorithm", "env", "name", "seed")
OF_ENTRIES = {"algorithm", "envs", "seeds", "config"}  # keys of an entry that are no settings


class Suite(NamedTuple):
    """Entries by name, over shared settings; both are settings of `train`, and envs and seeds."""

    name: str
    help: str
    shared: Settings
    entries: dict[str, Settings]
    folder: Path  # in which config files of entries are looked for
    allow: Collection[str] = ()  # names in its files that may import a module


class Job(NamedTuple):
    """One run: its checked settings, its folder, and the words of the command that starts it.

    `always` are flags that a command which resumes it takes as well.
    """

    config: Config
    directory: RunDirectory
    words: list[str]
    always: tuple[str, ...] = ()

    def __str__(self) -> str:
        run = self.config.run
        return f"{run.env} {run.name} seed {run.seed}"


def shipped() -> list[str]:
    """Names of the suites that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load(name: str) -> Suite:
    """A shipped suite by its name, or a file by its path."""
    path = FOLDER / f"{name}.toml" if name in shipped() else Path(name)
    if path.suffix != ".toml":
        raise unknown("suite", name, shipped())
    if not path.is_file():
        raise UsageError(f"suite: no file {path}; shipped are {', '.join(shipped())}")
    table = read_file(path)
    about, entries = table.pop("help", ""), table.pop("entries", None)
    if not isinstance(entries, dict) or not entries:
        raise UsageError(f"suite: {path} has no [entries.NAME]")
    if "algorithm" in table:
        raise UsageError(f"suite: {path}: algorithm belongs into an entry: [entries.NAME]")
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            raise UsageError(f"suite: {path}: entries.{name} must be a table")
        if not isinstance(entry.get("algorithm", name), str):
            raise UsageError(f"suite: {path}: entries.{name}: algorithm must be a name")
    named = {name: _with_underscores(entry) for name, entry in entries.items()}
    return Suite(path.stem, str(about), table, named, path.parent)


def of_algorithms(names: Iterable[str]) -> Suite:
    """A suite of algorithms or presets as they are."""
    entries: dict[str, Settings] = {name.replace(":", "-"): {"algorithm": name} for name in names}
    return Suite("bench", "", {}, entries, Path())


def require_named(suite: Suite, allow: Collection[str], envs: Collection[str]) -> None:
    """Refuse names in the suite's file that import a module and are not allowed.

    If the command line gives `envs`, the file's own are not used.
    """
    for name, entry in suite.entries.items():
        require("algorithm", entry.get("algorithm", name), allow)
        merged = suite.shared | entry
        for env in _envs(merged["envs"]) if "envs" in merged and not envs else ():
            require("env", env, allow)
        require_all("wrap", merged.get("wrap", ()), allow)


def pick(suite: Suite, names: Iterable[str]) -> Suite:
    """Only some entries of a suite."""
    for name in names:
        if name not in suite.entries:
            raise unknown("algos", name, suite.entries)
    return suite._replace(entries={name: suite.entries[name] for name in names})


def count(suite: Suite) -> int:
    """The number of runs, without a look at their settings."""
    tables = [suite.shared | entry for entry in suite.entries.values()]
    return sum(len(_envs(t.get("envs"))) * len(_seeds(t.get("seeds", 1))) for t in tables)


def expand(
    suite: Suite, flags: Settings, runs: str | Path, always: tuple[str, ...] = ()
) -> list[Job]:
    """Every run, the first seed of all entries first; flags win over what the suite says."""
    jobs: list[Job] = []
    for name, entry in suite.entries.items():
        merged = suite.shared | entry | flags
        try:
            for env in _envs(merged.get("envs")):
                below = _file(suite, merged.get("config"), env)
                shared, own = _for_env(suite.shared, env), _for_env(entry, env)
                given = merge(*shared, below, *own, flags)
                if "wrap" not in flags:
                    require_all("wrap", given.get("wrap", ()), suite.allow)
                jobs += _jobs(name, env, _seeds(merged.get("seeds", 1)), given, runs)
        except UsageError as error:
            raise UsageError(f"{suite.name}, entry {name}: {error}") from None
    jobs = [job._replace(always=(*always, *job.always)) for job in jobs]
    return sorted(jobs, key=lambda job: job.config.run.seed)


def _for_env(table: Settings, env: str) -> Iterable[Settings]:
    """A suite's or an entry's settings for a task: `env."PATTERN"` wins over the rest of it."""
    by_env: Any = table.get("env", {})
    if not isinstance(by_env, dict) or not all(isinstance(t, dict) for t in by_env.values()):
        raise UsageError('env: must be tables of settings by task, such as env."HalfCheetah-*"')
    yield {key: value for key, value in table.items() if key != "env"}
    for pattern, own in by_env.items():
        if wrong := sorted(OF_ENTRIES & own.keys()):
            raise UsageError(f'{wrong[0]}: is for all tasks; it cannot stand in env."{pattern}"')
        if fnmatchcase(env, pattern):
            yield _with_underscores(own)


def _jobs(
    name: str, env: str, seeds: list[int], given: Settings, runs: str | Path
) -> Iterable[Job]:
    own = {key: value for key, value in given.items() if key not in OF_ENTRIES}
    algorithm = given.get("algorithm", name)
    for key in DECIDED:
        if key in own:
            raise UsageError(f"{key}: cannot be set here; the entry's name, envs and seeds set it")
    run, hyper = resolve(algorithm, env, own, {"name": name})
    usual = resolve(algorithm, env).settings()
    differing = {k: v for k, v in Config(run, hyper).settings().items() if v != usual[k]}
    again = {k: own[k] for k in sorted(WITHOUT_RESULT & own.keys()) if own[k] is not None}
    for seed in seeds:
        config = Config(replace(run, seed=seed), hyper)
        words = ["train", algorithm, env, f"--seed={seed}", *_flags(differing), f"--runs={runs}"]
        yield Job(config, RunDirectory.of(runs, config), words, tuple(_flags(again)))


def _flags(settings: Settings) -> Iterable[str]:
    """Settings as flags of `train`."""
    for key, value in settings.items():
        flag = key.replace("_", "-")
        if key == "env_kwargs":
            yield from (f"--env.{name}={_keyword(each)}" for name, each in value.items())
        elif isinstance(value, dict):
            yield from (f"--{flag}={n}={','.join(map(str, each))}" for n, each in value.items())
        elif isinstance(value, bool):
            yield f"--{flag}" if value else f"--no-{flag}"
        elif isinstance(value, (tuple, list)):
            yield from (f"--{flag}", *map(str, value))
        elif value is None:
            raise UsageError(f"{key}: has a value in the preset and cannot be unset")
        else:
            yield f"--{flag}={value}"


def _keyword(value: Any) -> str:
    """A keyword of an env as `--env.KEY` reads it."""
    if value is None:
        return "none"
    return repr(value) if isinstance(value, float) else json.dumps(value)  # inf, not Infinity


def _envs(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value) or not value:
        raise UsageError("envs: must be a list of env ids, such as --envs Ant-v5 Walker2d-v5")
    return list(dict.fromkeys(map(full_id, value)))


def _seeds(value: Any) -> list[int]:
    count = value if type(value) is int else len(value) if isinstance(value, list) else 0
    if count > MOST_SEEDS:
        raise UsageError(f"seeds: must be at most {MOST_SEEDS:,} per entry")
    seeds: Any = list(range(value)) if type(value) is int else value
    whole = isinstance(seeds, list) and all(type(seed) is int for seed in seeds)
    if not whole or not seeds:
        raise UsageError(f"seeds: must be how many, or a list of them, got {value!r}")
    if not all(0 <= seed < TUNING_SEEDS for seed in seeds):
        raise UsageError(f"seeds: must be from 0 to {TUNING_SEEDS - 1}; `tune` uses those above")
    return list(dict.fromkeys(seeds))


def _file(suite: Suite, file: Any, env: str) -> Settings:
    """Settings from an entry's config file, whose name may hold {env}."""
    if file is None:
        return {}
    if not isinstance(file, str):
        raise UsageError(f"config: must be the path of a file, got {file!r}")
    table = read_file(suite.folder / file.replace("{env}", env.replace("/", "-")))
    return {key: value for key, value in table.items() if key not in DECIDED}


def _with_underscores(table: Settings) -> Settings:
    return {key.replace("-", "_"): value for key, value in table.items()}

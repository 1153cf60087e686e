"""Run directories: their files, and what a result needs to be repeated."""

from pacesetter.runs.directory import (
    FREE_PER_SEED,
    OLDER,
    SCHEMA,
    WITHOUT_RESULT,
    RunDirectory,
)
from pacesetter.runs.finding import find, find_all, find_each, find_group, find_matching
from pacesetter.runs.log import Row

__all__ = [
    "FREE_PER_SEED",
    "OLDER",
    "SCHEMA",
    "WITHOUT_RESULT",
    "Row",
    "RunDirectory",
    "find",
    "find_all",
    "find_each",
    "find_group",
    "find_matching",
]

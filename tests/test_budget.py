"""What a run may spend, read off its flat settings."""

import pytest

from pacesetter.config import resolve
from pacesetter.settings import budget


@pytest.mark.parametrize(("count", "steps"), [("all", 900), ("member", 2700)])
def test_budget_in_steps_of_all_members(count: str, steps: int) -> None:
    """The same from a table of settings and from checked ones."""
    given = {"members": 3, "count": count, "steps": 900}
    config = resolve("td3", "HalfCheetah-v5", given)
    assert budget.budget(given) == config.budget == steps
    assert config.steps_per_count == steps // 900
    assert budget.budget(config.settings()) == steps


@pytest.mark.parametrize(
    ("step", "seconds", "time", "spent"),
    [
        (899, 1e9, None, False),
        (900, 0.0, None, True),
        (1, 59.9, 60.0, False),
        (1, 60.0, 60.0, True),
        (900, 0.0, 60.0, True),
    ],
)
def test_a_run_ends_by_its_steps_or_its_time(
    step: int, seconds: float, time: float | None, spent: bool
) -> None:
    settings = {"members": 1, "count": "all", "steps": 900, "time": time}
    assert budget.is_spent(settings, step, seconds, budget.Standing()) is spent

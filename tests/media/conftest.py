"""What tests of films share."""

import pytest
from policies import untrained

from pacesetter.policy import Policy


@pytest.fixture
def cheetah() -> Policy:
    return untrained("HalfCheetah-v5")

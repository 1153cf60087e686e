"""What tests of films share."""

from pathlib import Path

import pytest
from policies import untrained

from pacesetter.errors import UsageError
from pacesetter.media.record import record
from pacesetter.media.scene import INSTALL
from pacesetter.policy import Policy


@pytest.fixture
def cheetah() -> Policy:
    return untrained("HalfCheetah-v5")


@pytest.fixture
def gl(cheetah: Policy, tmp_path: Path) -> None:
    """Skip where this machine cannot draw; MuJoCo needs OpenGL, which pip does not install."""
    try:
        record(cheetah, tmp_path / "probe.gif", frames=1)
    except UsageError as error:
        if INSTALL not in str(error):
            raise
        pytest.skip(str(error))

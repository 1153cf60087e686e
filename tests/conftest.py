"""Fixtures that all tests may use."""

from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from broken_envs import Late
from policies import untrained

from pacesetter.errors import UsageError
from pacesetter.learner.backend import prepare
from pacesetter.media.record import record
from pacesetter.media.scene import INSTALL


@pytest.fixture(scope="session", autouse=True)
def _keep_compiled() -> None:
    """Programs are kept between test runs, as a trainer keeps them."""
    prepare("auto")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Where a test's runs lie."""
    return tmp_path / "runs"


@pytest.fixture
def gl(tmp_path: Path) -> None:
    """Skip where this machine cannot draw; MuJoCo needs OpenGL, which pip does not install."""
    try:
        record(untrained("HalfCheetah-v5"), tmp_path / "probe.gif", frames=1, size=(32, 32))
    except UsageError as error:
        if INSTALL not in str(error):
            raise
        pytest.skip(str(error))


@pytest.fixture
def disarmed() -> Iterator[None]:
    """No task of this test fails after it."""
    yield
    Late.disarm()


@pytest.fixture
def nans_raise() -> Iterator[None]:
    """JAX raises where a NaN arises; in every thread, unlike in the context of `debug_nans`."""
    jax.config.update("jax_debug_nans", True)
    yield
    jax.config.update("jax_debug_nans", False)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)

"""What a run asks of JAX: its device, its numbers, and where compiled programs are kept."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from pacesetter.errors import TrainingError, UsageError
from pacesetter.process import cores, threads

# JAX's own defaults, held fast: the numbers of a seed depend on them.
NUMERICS: dict[str, Any] = {
    "jax_enable_x64": False,
    "jax_default_prng_impl": "threefry2x32",
    "jax_threefry_partitionable": True,
    "jax_random_seed_offset": 0,
    "jax_default_matmul_precision": None,
}
OUTSIDE = ("XLA_FLAGS", "NVIDIA_TF32_OVERRIDE")  # what is only recorded, where it is set


def prepare(device: str) -> list[str]:
    """Choose the device, fix what numbers depend on, and keep compiled programs, of which JAX
    stores none by default.

    Returns a line for each setting of this process that had to change. Raises UsageError.
    """
    notes: list[str] = []
    for name, value in NUMERICS.items():
        if (found := jax.config.values[name]) != value:
            jax.config.update(name, value)
            notes.append(f"{name} was {found}, is {value} now: a seed's numbers depend on it")
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and "HOME" in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        # XLA splits loops for the cores it compiles on, which JAX's own key for a program ignores.
        place = f"{threads()}-threads-{len(cores())}-cores"
        jax.config.update("jax_compilation_cache_dir", str(home / "pacesetter" / place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    _refuse_no_device()
    jax.config.update("jax_default_device", None if device == "auto" else _device(device))
    return notes


@contextmanager
def device_faults() -> Generator[None]:
    """Tell a fault of the device, such as too little memory, as a TrainingError."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        full = "RESOURCE_EXHAUSTED" in str(error)
        what = "is out of memory, lower --members, --batch-size or the widths" if full else "fails"
        raise TrainingError(f"the {platform()} {what}: {error}") from error


def made_with(products: str) -> dict[str, Any]:
    """What a run's numbers depend on beside its settings, versions and threads, for its record;
    `products` is who makes matrix products.
    """
    numerics = {name: jax.config.values[name] for name in NUMERICS}
    numerics |= {name: os.environ[name] for name in OUTSIDE if name in os.environ}
    return {"backend": platform(), "products": products, "numerics": numerics}


def platform() -> str:
    """Where updates run: cpu, gpu or tpu."""
    device: Any = jax.config.values["jax_default_device"] or jax.devices()[0]
    return device.platform


def _refuse_no_device() -> None:
    """Refuse platforms that this machine has not, which else is a traceback at the first array."""
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS")
        if asked is None:
            raise UsageError(f"device: JAX finds none: {error}") from None
        raise UsageError(
            f"JAX_PLATFORMS: this machine has no '{asked}'; unset it, or set it to cpu"
        ) from None


def _device(kind: str) -> Any:
    try:
        return jax.devices(kind)[0]
    except RuntimeError:
        present = ", ".join(sorted({device.platform for device in jax.devices()}))
        raise UsageError(f"device: this machine has no {kind}; it has {present}") from None

"""What a run asks of JAX: its device, and where compiled programs are kept."""

import os
from pathlib import Path
from typing import Any

import jax

from pacesetter.errors import UsageError
from pacesetter.process import threads


def prepare(device: str) -> None:
    """Choose the device and keep compiled programs, of which JAX stores none by default."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and "HOME" in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        # XLA splits loops for the cores it compiles on, which JAX's own key for a program ignores.
        cores = f"{threads()}-threads-{len(os.sched_getaffinity(0))}-cores"
        jax.config.update("jax_compilation_cache_dir", str(home / "pacesetter" / cores))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if device != "auto":
        jax.config.update("jax_default_device", _device(device))


def platform() -> str:
    """Where updates run: cpu, gpu or tpu."""
    device: Any = jax.config.values["jax_default_device"] or jax.devices()[0]
    return device.platform


def _device(kind: str) -> Any:
    try:
        return jax.devices(kind)[0]
    except RuntimeError:
        present = ", ".join(sorted({device.platform for device in jax.devices()}))
        raise UsageError(f"device: this machine has no {kind}; it has {present}") from None

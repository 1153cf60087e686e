"""What a run asks of JAX: its device, where programs are kept, how XLA compiles updates."""

import os
from functools import cache
from pathlib import Path
from typing import Any

import jax

from pacesetter.errors import UsageError
from pacesetter.process import threads

# XLA then overwrites weights without a copy first. Updates a second on two cores, with over
# without: sac 1.04, td3 1.01, ddpg 0.94; on one core and for several members no difference.
IN_PLACE = {"xla_cpu_copy_insertion_use_region_analysis": True}


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


def compiler_options() -> dict[str, Any] | None:
    """What updates are compiled with; none where this XLA does not know it, or off the CPU."""
    device: Any = jax.config.values["jax_default_device"] or jax.devices()[0]
    return IN_PLACE if device.platform == "cpu" and _knows(*IN_PLACE.items()) else None


@cache
def _knows(*options: tuple[str, Any]) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options=dict(options)).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def _device(kind: str) -> Any:
    try:
        return jax.devices(kind)[0]
    except RuntimeError:
        present = ", ".join(sorted({device.platform for device in jax.devices()}))
        raise UsageError(f"device: this machine has no {kind}; it has {present}") from None

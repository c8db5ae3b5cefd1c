"""Compiled programs kept on disk, so that the next process loads them instead of compiling."""

from __future__ import annotations

import os
import platform
import sys
import zlib
from pathlib import Path
from typing import Any

# Environment variable with the folder of traced programs (`kept_programs`), for this process and those that it starts.
TRACED_FOLDER = "DPMJAX_TRACED"
CACHES = "Library/Caches" if sys.platform == "darwin" else ".cache"
# Hundreds of small programs take seconds together, so programs of any size and compile time are kept.
_SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def enable_compile_cache(folder: str | Path | None = None) -> Path | None:
    """Keeps compiled programs in a folder, from which later processes load them.

    Commands and pipelines call it by themselves where JAX has no cache yet; for kernels alone, call it before the first
    computation. The environment variable `DPMJAX_CACHE=0` turns the cache off.

    Args:
        folder: folder of the programs; None takes the environment variables `DPMJAX_CACHE` and
            `JAX_COMPILATION_CACHE_DIR`, then `$XDG_CACHE_HOME/dpmjax` or the user's folder for caches, where each kind
            of processor has a folder.

    Returns:
        The folder; None where the cache is off.
    """
    chosen = os.environ.get("DPMJAX_CACHE", "")
    if chosen in ("0", "off"):
        return None
    path = Path(folder or chosen or os.environ.get("JAX_COMPILATION_CACHE_DIR") or _user_folder())
    settings = {"jax_compilation_cache_dir": str(path), **_SETTINGS}
    # Processes that this one starts inherit the settings.
    os.environ |= {name.upper(): str(value) for name, value in settings.items()}
    os.environ[TRACED_FOLDER] = str(path / "traced")
    if "jax" in sys.modules:
        import jax
        from jax.experimental.compilation_cache import compilation_cache

        for name, value in settings.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()  # JAX looks for a cache once, when it first compiles
    return path


def keep_programs() -> None:
    """Switches the cache on where JAX has none yet."""
    import jax

    options: Any = jax.config
    if options.jax_compilation_cache_dir is None:
        enable_compile_cache()


def cpu_model() -> str:
    """Returns the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    fields = (line.partition(":") for line in lines)
    names = [value.strip() for name, _, value in fields if name.strip() == "model name"]
    return names[0] if names else platform.processor() or platform.machine()


def _user_folder() -> Path:
    # A compiled program belongs to a kind of processor, and a home directory may be shared by several kinds.
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / CACHES) / "dpmjax"
    return caches / f"{zlib.crc32(cpu_model().encode()):08x}"

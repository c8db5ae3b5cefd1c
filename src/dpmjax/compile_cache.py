"""Compiled programs kept on disk, so that the next process loads them instead of compiling."""

from __future__ import annotations

import functools
import logging
import math
import os
import platform
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)
# A pipeline that compiles for longer than this says so; a process that loads its programs stays below.
_SILENT_S = 2.0
# Seconds of each program, compiled or loaded, and seconds of those that were loaded.
_SHARES = {"/jax/core/compile/backend_compile_duration": 1.0, "/jax/compilation_cache/cache_retrieval_time_sec": -1.0}
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


@functools.cache
def keep_programs() -> None:
    """Switches the cache on where JAX has none yet, keeps traced programs, and logs where compilation takes long."""
    import jax

    options: Any = jax.config
    if options.jax_compilation_cache_dir is None:
        enable_compile_cache()
    elif os.environ.get("DPMJAX_CACHE") not in ("0", "off"):  # a cache of the user's own
        os.environ.setdefault(TRACED_FOLDER, str(Path(options.jax_compilation_cache_dir) / "traced"))
    folder = options.jax_compilation_cache_dir
    later = f"later processes load the programs from {folder}" if folder else "the cache of programs is off"
    jax.monitoring.register_event_duration_secs_listener(announcer(later))


def announcer(later: str) -> Callable[..., None]:
    """Makes a listener to events of JAX that warns once, after two seconds of compilation.

    Args:
        later: end of the message, on the next process.

    Returns:
        The listener.
    """
    waited_s = 0.0

    def announce(event: str, duration_secs: float, **_: Any) -> None:
        nonlocal waited_s
        before_s, waited_s = waited_s, waited_s + _SHARES.get(event, 0.0) * duration_secs
        if before_s <= _SILENT_S < waited_s:
            waited_s = math.inf
            _log.warning("compiling, for 10 to 60 s in all, once; %s", later)

    return announce


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

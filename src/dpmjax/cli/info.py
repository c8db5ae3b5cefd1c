"""Describes the machine of a run: versions, device, memory, cores, shipped weights, and optional packages.

    dpmjax info

Put this output at the beginning of a bug report.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import resource
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dpmjax import cli
from dpmjax.compile_cache import cpu_model, enable_compile_cache

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "scipy")
EXTRAS = {
    "cluster": ("distributed",),
    "baselines": ("evosax", "jaxopt", "open3d"),
    "gtsam": ("gtsam",),
    "kiss": ("kiss_matcher",),
    "las": ("laspy", "lazrs"),
    "ros": ("rosbags",),
    "peers": ("kiss_icp", "kiss_slam"),
    "viewer": ("rerun",),
    "torch": ("torch",),
}
"""Packages of each extra of dpmjax."""


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """The command has no options."""


def main(options: InfoOptions, run: cli.Run) -> cli.Numbers:
    """Prints versions, devices, weights and extras of this installation."""
    import jax

    from dpmjax.weights import read_card, shipped_models

    jax.devices()
    found = environment()
    print("versions   " + ", ".join(f"{name} {version}" for name, version in found["versions"].items()))
    print(f"device     {device_name()}; {found['num_cores']} cores, {found['cpu']}")
    print(f"cache      {enable_compile_cache() or 'off'} (compiled programs)")
    for name in shipped_models():
        print(f"weights    {name}: {read_card(name).removeprefix(f'{name}: ').split('. ')[0]} (docs/weights.md)")
    for extra, packages in EXTRAS.items():
        reasons = filter(None, map(why_not_importable, packages))
        print(f"extra      {extra}: {'; '.join(reasons) or 'installed'}")
    return {}


def environment() -> dict[str, Any]:
    """Returns versions, device, git commit, machine and peak memory, ready for `metrics.json`."""
    versions = {name: importlib.metadata.version(name) for name in ("dpmjax", *PACKAGES)}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "device": device_name(),
        "git_hash": git_hash(),
        "platform": platform.platform(),
        "cpu": cpu_model(),
        # A container may limit the cores of a process.
        "num_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "peak_rss_gb": peak_rss_gb(),
    }


def device_name() -> str | None:
    """Returns the device that JAX computes on; None in a run that never loaded JAX."""
    if "jax" not in sys.modules:
        return None
    import jax

    devices = jax.devices()
    return f"{devices[0].platform} ({devices[0].device_kind}) x {len(devices)}"


def git_hash() -> str | None:
    """Returns the commit of this checkout, with `+changes` if it is not clean; None for an installed package."""
    root = Path(__file__).parents[3]
    if not (root / "src" / "dpmjax").is_dir():  # a checkout around site-packages is another project's
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run([*command, "--dirty=+changes"], capture_output=True, text=True, check=True, timeout=5)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()


def peak_rss_gb() -> float:
    """Returns the largest resident memory of this process so far, in units of 10^9 bytes."""
    # On Linux, ru_maxrss starts from the parent's size at the fork; VmHWM belongs to this program alone.
    status = Path("/proc/self/status")
    if status.exists() and (own := re.search(r"VmHWM:\s*(\d+)", status.read_text(errors="replace"))):
        return int(own[1]) * 1024 / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


def why_not_importable(module: str) -> str | None:
    """Returns the reason why a module cannot be imported; None if it can.

    The module is imported, because an installed package may be broken. For example, a library of the system may be
    missing, or a compiled part may be built for another version of NumPy. Only the import shows this, by any error.

    Args:
        module: name of a package or of a module in it.

    Returns:
        One line: the missing package and the command that installs it, or the error of the import.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = error.name or module
        package = next((f"dpmjax[{extra}]" for extra, packages in EXTRAS.items() if missing in packages), missing)
        return f"{missing} is not installed (pip install '{package}')"
    except Exception as error:
        lines = str(error).splitlines() or [type(error).__name__]
        return f"{module} is installed, but its import fails: {lines[0]}"
    return None


def require_importable(module: str, option: str) -> None:
    """Raises a ValueError that names the option if its module cannot be imported."""
    if (reason := why_not_importable(module)) is not None:
        raise ValueError(f"{option}: {reason}")

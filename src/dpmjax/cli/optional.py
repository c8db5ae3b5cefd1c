"""Packages of the extras: why one of them cannot be used, in one line, before any work."""

from __future__ import annotations

import importlib
import warnings

EXTRAS = {
    "evosax": "baselines",
    "jaxopt": "baselines",
    "open3d": "baselines",
    "gtsam": "gtsam",
    "kiss_matcher": "kiss",
    "laspy": "las",
    "lazrs": "las",
    "rosbags": "ros",
    "kiss_icp": "peers",
    "kiss_slam": "peers",
    "rerun": "viewer",
    "torch": "torch",
}
"""The extra of dpmjax that brings a package."""


def why_not_importable(module: str) -> str | None:
    """Returns why a module cannot be imported; None where it can.

    The module is imported, because an installed package may be broken: a missing library of the system, or a compiled
    part that was built for another version of NumPy, shows at the import only, and as any kind of error.

    Args:
        module: name of a package or of a module in it.

    Returns:
        One line: the package that is not installed and the command that installs it, or the error of the import.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = error.name or module
        package = f"dpmjax[{EXTRAS[missing]}]" if missing in EXTRAS else missing
        return f"{missing} is not installed (pip install '{package}')"
    except Exception as error:
        lines = str(error).splitlines() or [type(error).__name__]
        return f"{module} is installed, but its import fails: {lines[0]}"
    return None


def require_importable(module: str, option: str) -> None:
    """Raises a ValueError that names the option, where a module that the option needs cannot be imported."""
    if (reason := why_not_importable(module)) is not None:
        raise ValueError(f"{option}: {reason}")

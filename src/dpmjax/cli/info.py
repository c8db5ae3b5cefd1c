"""Prints versions, devices, the shipped weights, and which optional packages are there.

    dpmjax info

A bug report begins with what this prints.
"""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dpmjax.cli.command import run_command
from dpmjax.cli.machine import device_name, environment

NAME = "info"


@dataclass(frozen=True, kw_only=True)
class Config:
    """The command has no options."""


def main(config: Config) -> None:
    """Prints what this installation has."""
    import jax

    from dpmjax.compile_cache import enable_compile_cache
    from dpmjax.weights import read_card, shipped_models

    jax.devices()
    found = environment()
    print("versions   " + ", ".join(f"{name} {version}" for name, version in found["versions"].items()))
    print(f"device     {device_name()}; {found['num_cores']} cores, {found['cpu']}")
    print(f"cache      {enable_compile_cache() or 'off'} (compiled programs)")
    for name in shipped_models():
        print(f"weights    {name}: {read_card(name)}")
    for extra, missing in missing_packages().items():
        state = f"needs {', '.join(missing)}: pip install 'dpmjax[{extra}]'" if missing else "installed"
        print(f"extra      {extra}: {state}")


def missing_packages() -> dict[str, list[str]]:
    """Returns the packages of each extra for users that are not installed."""
    found: dict[str, list[str]] = {}
    for requirement in importlib.metadata.requires("dpmjax") or ():
        name, extra = re.match(r"[\w.-]+", requirement), re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        if name is None or extra is None or extra[1] == "dev":
            continue
        missing = found.setdefault(extra[1], [])
        try:
            importlib.metadata.version(name[0])
        except importlib.metadata.PackageNotFoundError:
            missing.append(name[0])
    return found


def run(args: Sequence[str] | None = None) -> int:
    """Runs the subcommand; returns the exit code."""
    return run_command(main, Config, name=NAME, description=__doc__, args=args)

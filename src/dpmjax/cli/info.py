"""Prints versions, devices, the shipped weights, and which optional packages are there.

    dpmjax info

A bug report begins with what this prints.
"""

from __future__ import annotations

from dataclasses import dataclass

from dpmjax.cli.machine import EXTRAS, device_name, environment, why_not_importable

NAME = "info"


@dataclass(frozen=True, kw_only=True)
class Config:
    """The command has no options."""


def main(config: Config) -> None:
    """Prints versions, devices, weights and extras of this installation."""
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
    for extra, reasons in unusable_packages().items():
        print(f"extra      {extra}: {'; '.join(reasons) or 'installed'}")


def unusable_packages() -> dict[str, list[str]]:
    """Returns the import errors of the packages of each extra; empty where all can be imported."""
    found: dict[str, list[str]] = {}
    for package, extra in EXTRAS.items():
        reasons = found.setdefault(extra, [])
        if (reason := why_not_importable(package)) is not None:
            reasons.append(reason)
    return found

"""Describes the machine of a run: versions, device, memory, cores, shipped weights, and optional packages.

    dpmjax info

A bug report begins with what this prints.
"""

from __future__ import annotations

from dataclasses import dataclass

from dpmjax import cli
from dpmjax.cli.machine import EXTRAS, device_name, environment, why_not_importable
from dpmjax.compile_cache import enable_compile_cache


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

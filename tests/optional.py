"""Tests that need a package of an extra are skipped with the reason, also if the package is broken."""

import importlib
from types import ModuleType

import pytest

from dpmjax.cli.info import why_not_importable


def import_or_skip(module: str) -> ModuleType:
    """Returns the module; skips the test where its import raises any error, not an ImportError alone."""
    if (reason := why_not_importable(module)) is not None:
        pytest.skip(reason)
    return importlib.import_module(module)

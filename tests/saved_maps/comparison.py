"""Comparison of saved things bit for bit, and of whole files with damaged ones."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dpmjax.geometry.neighbours import HostTree
from dpmjax.io import InputError


def assert_same(found: object, expected: object) -> None:
    """All fields are the same, bit for bit and of the same kind."""
    assert type(found) is type(expected)
    if isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == expected.dtype
    elif isinstance(expected, tuple):
        assert len(found) == len(expected)
        for a, b in zip(found, expected, strict=True):
            assert_same(a, b)
    elif isinstance(expected, HostTree):
        np.testing.assert_array_equal(found.points, expected.points)
    elif hasattr(expected, "__dataclass_fields__"):
        for name in expected.__dataclass_fields__:
            assert_same(getattr(found, name), getattr(expected, name))
    else:
        assert found == expected


def assert_damage_is_refused(path: Path, content: bytes, load: Callable[[Path], object], num_files: int) -> None:
    """Files that are cut or have one flipped bit load as the whole one, or are refused, most of those that are cut."""
    path.write_bytes(content)
    whole, num_refused, rng = load(path), 0, np.random.default_rng(0)
    headers = [info.header_offset for info in zipfile.ZipFile(io.BytesIO(content)).infolist()]
    for number in range(num_files):
        damaged = bytearray(content)
        if number % 4 == 0:
            damaged = damaged[: rng.integers(len(content))]
        else:
            # Half of the flips go into the headers of the archive, which are short.
            start = headers[rng.integers(len(headers))] if number % 2 else rng.integers(len(content))
            damaged[min(start + rng.integers(60), len(content) - 1)] ^= 1 << rng.integers(8)
        path.write_bytes(bytes(damaged))
        try:
            found = load(path)
        except InputError:
            num_refused += 1
            continue
        assert_same(found, whole)
    assert num_refused > num_files / 4

"""Names of scan files: order, times in names, and files among scans that are no scans."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpmjax.io.files import natural_key
from dpmjax.sequences import FloatArray

_NUMBER = re.compile(r"\d+(?:\.\d+)?|\.\d+")
# A number of that many digits is a time stamp: seconds since 1970, or a smaller unit.
_STAMP_DIGITS = 10
_LEAST_NUMBERED = 3


def stem_of(file: Path) -> str:
    """Returns the name without its endings, of which `.pcd.bin` has two."""
    return file.name[: -len(".pcd.bin")] if file.name.lower().endswith(".pcd.bin") else file.stem


def sort_scans(files: Sequence[Path]) -> list[Path]:
    """Sorts scans by the numbers in their names: 2 before 10, and 0.05 before 0.1 where the numbers are decimals.

    A number with a point is a decimal where the digits after the point differ in count and none of the longer ones ends
    in 0, as programs print them. Otherwise, both sides of the point are counted on their own, as of 1.9 and 1.10.

    Args:
        files: files in any order.

    Returns:
        The files in order.
    """
    stems = [stem_of(file) for file in files]
    fractions = [piece.partition(".")[2] for stem in stems for piece in _NUMBER.findall(stem) if "." in piece]
    is_decimal = len({len(fraction) for fraction in fractions}) > 1 and not any(
        len(fraction) > 1 and fraction.endswith("0") for fraction in fractions
    )
    return sorted(files, key=lambda file: _decimal_key(stem_of(file)) if is_decimal else natural_key(file.name))


def _decimal_key(stem: str) -> tuple[tuple[int, float, str], ...]:
    """Returns a sort key under which numbers, with their fractions, compare as numbers and come before text."""
    texts, numbers = _NUMBER.split(stem), _NUMBER.findall(stem)
    key: list[tuple[int, float, str]] = []
    for text, number in zip(texts, [*numbers, ""], strict=True):
        key += [(1, 0.0, text)] * (text != "") + [(0, float(number or 0), number)] * (number != "")
    return tuple(key)


def strays_among(files: Sequence[Path]) -> list[Path]:
    """Finds files without a number among three numbered ones at least, such as `map.pcd` among 0001.pcd, 0002.pcd.

    Args:
        files: files of one ending.

    Returns:
        The files that are no scans; empty where half of the files or more have no number.
    """
    plain = [file for file in files if not re.search(r"\d", stem_of(file))]
    num_numbered = len(files) - len(plain)
    return plain if num_numbered >= max(_LEAST_NUMBERED, len(plain) + 1) else []


def stamps_in_names(files: Sequence[Path]) -> FloatArray | None:
    """Reads the time stamps that are the last numbers in the names: decimals, or numbers of ten digits or more.

    Args:
        files: the scans in order.

    Returns:
        (n,) in any unit; None where a name has none, or they do not increase.
    """
    found = [_NUMBER.findall(stem_of(file)) for file in files]
    last = [numbers[-1] if numbers else "" for numbers in found]
    if not last or not all("." in number or _STAMP_DIGITS <= len(number) < 20 for number in last):
        return None
    stamps = np.array([float(number) for number in last])
    return stamps if bool((np.diff(stamps) > 0).all()) else None

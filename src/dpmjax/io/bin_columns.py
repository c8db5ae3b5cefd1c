"""Points of raw float32 files, whose number of columns is inferred from the name and the values."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import read_bytes
from dpmjax.sequences import InputError, Note, require

_LAYOUTS = (3, 4, 5, 6, 7, 8)
USUAL_COLUMNS = 4
_NUSCENES_ENDING, _NUSCENES_COLUMNS = ".pcd.bin", 5
# Largest number of values, largest number of bins of their histogram, and least number of values of a bin.
_MOST_VALUES, _MOST_BINS, _LEAST_PER_BIN = 60_000, 64, 50
# Mutual information of column and value: least value of the best layout, bits, and least ratio to the next layout.
_LEAST_BITS, _LEAST_RATIO = 0.05, 1.3
# Six and eight columns repeat the order of three and four, so their information must be larger by this ratio.
_DOUBLED_RATIO = 1.1
# Usual magnitudes of coordinates, least share of such float64, and largest share of their lower halves as float32.
_USUAL, _LEAST_DOUBLES, _MOST_HALVES = (1e-4, 1e5), 0.95, 0.7


class Float64Error(InputError):
    """A raw file of float64, as all files of its drive are."""


class Columns(NamedTuple):
    """The layout of raw files.

    Attributes:
        num_columns: number of values of each point, x, y and z first.
        note: source of the layout, or None for the four columns of KITTI.
    """

    num_columns: int
    note: Note | None = None


def find_columns(path: Path, content: bytes) -> Columns:
    """Infers the columns of a raw file.

    The correct layout has values of one kind in each column, and a wrong one mixes them. So the layout with the largest
    mutual information of column and value is taken. `.pcd.bin` files, as those of nuScenes, have five columns unless
    the values contradict.

    Args:
        path: the file.
        content: its bytes.

    Returns:
        The layout, with a note where it is not KITTI's, or where the values fit another as well.

    Raises:
        Float64Error: the file holds float64.
        InputError: the file has no whole number of points of the layout, or of any.
    """
    fitting = [n for n in _LAYOUTS if len(content) % (4 * n) == 0]
    values = np.frombuffer(content[: len(content) // 4 * 4], "<f4")
    if _are_doubles(values):
        raise Float64Error(path, "the values are float64", "save them as float32, or the points as .npy")
    inferred = _columns_by_values(values)
    is_nuscenes = path.name.lower().endswith(_NUSCENES_ENDING)
    if inferred is None and is_nuscenes and _NUSCENES_COLUMNS in fitting:
        return Columns(_NUSCENES_COLUMNS, Note(f"{path}: 5 columns a point, by its ending; --columns decides"))
    check_size(path, len(content), inferred or USUAL_COLUMNS)
    if inferred is not None:
        text = f"{path}: {inferred} columns a point, inferred from the values; --columns decides"
        return Columns(inferred, None if inferred == USUAL_COLUMNS else Note(text))
    others = " or ".join(str(n) for n in fitting if n != USUAL_COLUMNS)
    text = f"{path}: 4 columns a point are assumed, {others} would fit as well; --columns decides"
    return Columns(USUAL_COLUMNS, Note(text, is_doubt=True) if others and content else None)


def check_size(path: str | Path, size: int, columns: int) -> None:
    """Refuses a raw file that is cut off, or has other columns.

    Args:
        path: the file.
        size: its bytes.
        columns: number of values of a point.

    Raises:
        InputError: the size is no whole number of points.
    """
    found = f"{size} bytes are no whole number of points of {columns} float32: truncated, or other columns"
    others = [str(n) for n in _LAYOUTS if n != columns and size % (4 * n) == 0]
    advice = "copy the file again" + (f", or say --columns {' or '.join(others)}" if others else "")
    require(size % (4 * columns) == 0, path, found, advice)


def read_bin(path: Path, columns: int | None) -> NDArray[np.float32]:
    """Reads x, y and z of a raw file.

    Args:
        path: the file.
        columns: number of values of a point; None: inferred from the values.

    Returns:
        (n, 3).

    Raises:
        InputError: see `find_columns`.
    """
    content = read_bytes(path)
    if columns is None:
        columns = find_columns(path, content).num_columns
    check_size(path, len(content), columns)
    return np.frombuffer(content, "<f4").reshape(-1, columns)[:, :3]


def columns_of_drive(files: Iterable[Path]) -> Columns:
    """Infers the columns of the raw files of a drive by the first one that can be read.

    Args:
        files: the scans.

    Returns:
        The layout; KITTI's where no file is raw, or none can be inferred.

    Raises:
        Float64Error: the first file holds float64.
    """
    for file in files:
        if file.suffix.lower() != ".bin":
            break
        try:
            content = read_bytes(file)
            if content:
                return find_columns(file, content)
        except Float64Error:
            raise
        except InputError:  # named where it is read
            continue
    return Columns(USUAL_COLUMNS)


def _are_doubles(values: NDArray[np.float32]) -> bool:
    """Returns True for coordinates in float64, whose lower halves are bits without a meaning."""
    halves = values[: min(len(values), _MOST_VALUES) // 2 * 2]
    doubles = halves.view("<f8")
    is_there = doubles != 0
    if not is_there.any():
        return False
    with np.errstate(invalid="ignore"):
        shares = [
            float(((_USUAL[0] < np.abs(numbers)) & (np.abs(numbers) < _USUAL[1])).mean())
            for numbers in (doubles[is_there], halves[::2][is_there])
        ]
    return shares[0] >= _LEAST_DOUBLES and shares[1] <= _MOST_HALVES


def _columns_by_values(values: NDArray[np.float32]) -> int | None:
    """Finds the layout of the largest mutual information of column and value; None where no layout stands out."""
    values = values[:_MOST_VALUES]
    num_bins = min(_MOST_BINS, len(values) // (_LEAST_PER_BIN * max(_LAYOUTS)))
    if num_bins < 4:
        return None
    with np.errstate(invalid="ignore"):
        finite = np.nan_to_num(values.astype(np.float64))
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, num_bins + 1)[1:-1]))
    bins = np.searchsorted(edges, finite, side="right")
    bits = {n: _information_bits(bins, n, len(edges) + 1) for n in _LAYOUTS}
    for doubled in (6, 8):
        if bits[doubled] < _DOUBLED_RATIO * bits[doubled // 2]:
            del bits[doubled]
    (best, most), (_, second), *_ = sorted(bits.items(), key=lambda entry: -entry[1])
    is_clear = most >= _LEAST_BITS and most >= _LEAST_RATIO * second
    return best if is_clear else None


def _information_bits(bins: NDArray[np.int64], columns: int, num_bins: int) -> float:
    """Computes the mutual information of value and column, corrected for few samples (Miller and Madow 1955)."""
    rows = bins[: len(bins) // columns * columns].reshape(-1, columns)
    counts = np.stack([np.bincount(column, minlength=num_bins) for column in rows.T]).astype(np.float64)
    joint = counts / counts.sum()
    independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    is_there = joint > 0
    bits = (joint[is_there] * np.log2(joint[is_there] / independent[is_there])).sum()
    return float(bits - (num_bins - 1) * (columns - 1) / (2 * np.log(2) * counts.sum()))

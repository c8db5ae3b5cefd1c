"""The entrance for 2-D scans: finds out what a path holds, reads it, and refuses what cannot be registered."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from dpmjax.io.scans2d.arrays import read_arrays
from dpmjax.io.scans2d.carmen import read_carmen_log
from dpmjax.io.scans2d.deepmapping_folder import read_deepmapping_folder
from dpmjax.sequences import InputError, ScanSequence

_log = logging.getLogger(__name__)
_FORMATS = "a folder or .tar of .pcd files, a CARMEN .log, .clf or .log.gz, or .npy / .npz arrays"
# Median ranges outside of these are a mistaken unit: millimetres, or pixels / 512.
_PLAUSIBLE_RANGE = {"m": (0.05, 500.0), "px": (2.0, 20000.0)}
# Few planar lidars measure farther; a sequence with hardly any shorter beam may be in millimetres.
_USUAL_M, _LEAST_USUAL_SHARE = 100.0, 0.05
_LEAST_BEAMS = 17  # Lines are fitted to up to 17 neighbouring beams.


def read_sequence(
    path: str | Path,
    *,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    unit: Literal["px", "m"] | None = None,
    max_range: float | None = None,
) -> ScanSequence:
    """Reads a sequence of planar scans, whatever of the known formats it is in.

    Args:
        path: a folder or tar archive of PCD files (`read_deepmapping_folder`), a CARMEN log (`read_carmen_log`), or a
            NumPy file (`read_arrays`). The ending decides, else the first bytes.
        start: first scan to keep.
        stop: scan to stop before; None for the end.
        stride: keep every `stride`-th scan.
        unit: unit of the file's lengths where the file does not state it; None takes PCD files as pixels / 512 and
            arrays as metres. CARMEN logs are in metres.
        max_range: beams of this length or more (in the sequence's unit) are masked; None leaves it to the reader.

    Returns:
        The sequence: two scans at least of 17 beams at least, each with one valid beam at least.

    Raises:
        InputError: one line with the file, what was found and what to do: no such file, an unknown format, damage, too
            few scans or beams, a scan without a valid beam, scans of a single point, lengths that no such unit
            explains, or arguments out of range.
    """
    path = Path(path)
    if start < 0 or stride < 1 or (stop is not None and stop < 0):
        raise InputError(
            path, f"start {start}, stop {stop}, stride {stride}", "start and stop count from 0, stride from 1"
        )
    if max_range is not None and not max_range > 0:
        raise InputError(path, f"max_range is {max_range}", "give a positive length")
    whole = _read_any(path, unit, max_range)
    if max_range is not None:
        whole = _limit(whole, max_range)
    sequence = whole.take(slice(start, stop, stride))
    if len(sequence) < 2:
        found = f"{len(sequence)} of {len(whole)} scans chosen (start {start}, stop {stop}, stride {stride})"
        raise InputError(path, found, "a registration needs two scans at least")
    _check_beams(sequence, path, start, stride)
    _check_unit(sequence, path)
    if whole.odometry_poses is None and whole.unit == "m":
        _log.info("%s: no raw odometry", path)
    return sequence


def _read_any(path: Path, unit: Literal["px", "m"] | None, max_range: float | None) -> ScanSequence:
    if not path.exists():
        raise InputError(path, "no such file or folder", "check the path")
    kind = _detect(path)
    if kind == "folder":
        return read_deepmapping_folder(path, unit=unit)
    if kind == "arrays":
        return read_arrays(path, unit=unit)
    if unit == "px":
        raise InputError(path, "a CARMEN log is in metres, not px", "leave the unit out")
    return read_carmen_log(path, max_range=max_range)


def _detect(path: Path) -> Literal["folder", "arrays", "carmen"]:
    """What the path holds, by its ending, else by its first bytes."""
    if path.is_dir():
        if any(file.suffix.lower() == ".pcd" for file in path.iterdir()):
            return "folder"
        raise InputError(path, "a folder without .pcd files", f"give {_FORMATS}")
    name = path.name.lower()
    if name.endswith((".tar", ".tar.gz", ".tgz")):
        return "folder"
    if name.endswith((".npy", ".npz")):
        return "arrays"
    if name.endswith((".log", ".clf", ".log.gz", ".clf.gz")):
        return "carmen"
    if name.endswith(".pcd"):
        raise InputError(path, "a single scan", "give the folder that holds all of its .pcd files")
    try:
        with path.open("rb") as file:
            head = file.read(65536)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path and its permissions") from error
    if head[257:262] == b"ustar":
        return "folder"
    if head[:6] == b"\x93NUMPY" or head[:2] == b"PK":
        return "arrays"
    if b"FLASER" in head:
        return "carmen"
    raise InputError(path, "an empty file" if not head else "no known format", f"give {_FORMATS}")


def _limit(sequence: ScanSequence, max_range: float) -> ScanSequence:
    """Masks the beams of `max_range` and more."""
    mask = sequence.mask & (np.linalg.norm(sequence.points, axis=2) < max_range)
    return replace(sequence, mask=mask, points=np.where(mask[..., None], sequence.points, np.float32(0)))


def _check_beams(sequence: ScanSequence, path: Path, start: int, stride: int) -> None:
    num_beams = sequence.mask.shape[1]
    if num_beams < _LEAST_BEAMS:
        found = f"scans of {num_beams} beams"
        raise InputError(path, found, f"give {_LEAST_BEAMS} beams or more; arrays are (scans, beams, 2)")
    empty = np.flatnonzero(~sequence.mask.any(axis=1))
    if len(empty) == len(sequence):
        found = "every beam of every scan is invalid or at maximum range"
        raise InputError(path, found, "check ranges and --max-range")
    if len(empty):
        found = (
            f"{len(empty)} of {len(sequence)} scans have no valid beam, the first is scan {start + stride * empty[0]}"
        )
        raise InputError(path, found, "remove such scans, or choose others by start, stop and stride")
    first = sequence.points[np.arange(len(sequence)), sequence.mask.argmax(axis=1)]
    if not ((sequence.points != first[:, None]).any(axis=2) & sequence.mask).any():
        raise InputError(path, "all points of each scan are one and the same", "give scans that see some surroundings")


def _check_unit(sequence: ScanSequence, path: Path) -> None:
    ranges = np.linalg.norm(sequence.points[sequence.mask].astype(np.float64), axis=1)
    median = float(np.median(ranges))
    low, high = _PLAUSIBLE_RANGE[sequence.unit]
    if not low <= median <= high:
        found = f"the median range is {median:.4g} {sequence.unit}"
        is_metric = sequence.unit == "m"
        advice = "convert millimetres to metres, or name the unit" if is_metric else "name the unit, or give pixels"
        raise InputError(path, found, advice)
    share = float((ranges < _USUAL_M).mean())
    if sequence.unit == "m" and share < _LEAST_USUAL_SHARE:
        _log.warning("%s: %.1f %% of the beams are below %g m; are these millimetres?", path, 100 * share, _USUAL_M)

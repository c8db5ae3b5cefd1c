"""Sequences of planar scans: detection of the format, reading, and checks of the scans."""

from __future__ import annotations

import tarfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry.shells import shell_radius
from dpmjax.io.carmen import read_carmen_log
from dpmjax.io.clouds import parse_pcd
from dpmjax.io.files import load_arrays, load_mat, log_notes, natural_key, read_bytes, refusing, to_float32
from dpmjax.io.poses import planar_rows
from dpmjax.io.scan_bags import is_bag, read_scan_bag
from dpmjax.sequences import FloatArray, Note, ScanSequence, Unit, counted, pad_scans, require

Table = Mapping[str, NDArray[np.generic]]
_FORMATS = "a folder or .tar of .pcd files, a CARMEN .log, .clf or .log.gz, a bag of ROS, or .npy / .npz arrays"
# Median ranges outside of these are a mistaken unit: millimetres, or pixels / 512.
_PLAUSIBLE_RANGE = {"m": (0.05, 500.0), "px": (2.0, 20000.0)}
# Few planar lidars measure farther; a sequence with hardly any shorter beam may be in millimetres.
_USUAL_M, _LEAST_USUAL_SHARE = 100.0, 0.05
# Least number of scans with beams at the largest range, and least share of scans that keep others.
_KEYS = "points (n, b, 2), or ranges (n, b) and angles (b,); optional mask (n, b), times (n,), poses, odometry, unit"
# Largest difference between the third coordinates of planar points.
_LARGEST_SPAN = 1.05 * 2.0 * np.pi  # Angles of one scan that span more are no radians.
# The DeepMapping authors' files: coordinates of PCD files are pixels / 512, so that a picture of 2048 pixels has a
# diagonal of 5.7. Poses are pixels and radians, in the variable `pose`.
_LEAST_BEAMS = 17  # Lines are fitted to up to 17 neighbouring beams.


def read_sequence(
    path: str | Path, *, selection: slice = slice(None), unit: Unit | None = None, topic: str | None = None
) -> ScanSequence:
    """Reads a sequence of planar scans in any of the known formats.

    Args:
        path: a folder or tar archive of PCD files (`read_deepmapping_folder`), a CARMEN log (`read_carmen_log`), a
            NumPy file (`read_arrays`), or a bag of ROS (`read_scan_bag`). The ending decides, else the first bytes.
        selection: start, stop and stride in scans.
        unit: unit of the file's lengths where the file does not state it; None takes PCD files as pixels / 512 and
            arrays as metres. CARMEN logs are in metres.
        topic: topic of planar scans of a bag; None: the only one.

    Returns:
        The sequence: at least two scans of at least 17 beams, most of them with a valid beam. Beams at the
        largest range are masked where they are no echoes (`shell_radius`).

    Raises:
        InputError: one line with the file, the finding and the advice. The file is missing, of an unknown format or
            damaged, or an argument is out of range. Also for too few scans or beams, most scans without a valid beam,
            scans of a single point, or impossible lengths.
    """
    path = Path(path)
    start, stop, stride = selection.start or 0, selection.stop, 1 if selection.step is None else selection.step
    is_good = start >= 0 and stride >= 1 and (stop is None or stop >= 0)
    chosen = f"start {start}, stop {stop}, stride {stride}"
    require(is_good, path, chosen, "start and stop count from 0, stride from 1")
    whole = _without_constant_odometry(_without_maxima(_read(path, unit, topic), path), path)
    sequence = whole.take(slice(start, stop, stride))
    is_part = len(sequence) < len(whole)
    found = f"{len(sequence)} of {len(whole)} scans chosen" if is_part else counted(len(whole), "scan")
    require(len(sequence) >= 2, path, found, "give two or more")
    notes = _check_beams(sequence, path, range(start, len(whole), stride)) + _check_unit(sequence, path)
    sequence = replace(sequence, notes=(*sequence.notes, *notes))
    log_notes(sequence.notes)
    return sequence


def _read(path: Path, unit: Unit | None, topic: str | None) -> ScanSequence:
    """Reads a whole file or folder; its ending decides on the reader, else its first bytes."""
    require(path.exists(), path, "no such file or folder", "check the path")
    has_scans = path.is_dir() and any(file.suffix.lower() == ".pcd" for file in path.iterdir())
    is_recording = is_bag(path) and not has_scans
    require(topic is None or is_recording, path, "no bag of ROS", "leave the topic out")
    is_known_folder = has_scans or is_recording or not path.is_dir()
    require(is_known_folder, path, "a folder without .pcd files", f"give {_FORMATS}")
    name, head = path.name.lower(), b"" if has_scans or is_recording else read_bytes(path)[:65536]
    is_single = name.endswith(".pcd") and not has_scans
    require(not is_single, path, "a single scan", "give the folder that holds all of its .pcd files")
    is_log = name.endswith((".log", ".clf", ".log.gz", ".clf.gz"))
    if has_scans or name.endswith((".tar", ".tar.gz", ".tgz")) or (head[257:262] == b"ustar" and not is_log):
        return read_deepmapping_folder(path, unit=unit)
    if name.endswith((".npy", ".npz")) or (head.startswith((b"\x93NUMPY", b"PK")) and not is_log):
        return read_arrays(path, unit=unit)
    is_log = is_log or b"FLASER" in head or b"ROBOTLASER1" in head
    found = "no known format" if head else "an empty file"
    require(is_log or is_recording, path, found, f"give {_FORMATS}")
    require(unit != "px", path, "a recording in metres, not px", "leave the unit out")
    return read_scan_bag(path, topic) if is_recording else read_carmen_log(path)


def _without_maxima(sequence: ScanSequence, path: Path) -> ScanSequence:
    """Masks beams without an echo, which many scanners write at their largest ranges."""
    radius = shell_radius(sequence.points[sequence.mask])
    if radius is None:
        return sequence
    is_echo = np.linalg.norm(sequence.points.astype(np.float64), axis=2) < radius
    mask, is_blind = sequence.mask & is_echo, sequence.mask & ~is_echo
    # A sensor that hardly sees anything else stands in a round room.
    if is_blind.any(axis=1).sum() < 3 or mask.any(axis=1).mean() < 0.5:
        return sequence
    share = 100 * is_blind.sum() / sequence.mask.sum()
    found = f"{share:.1f} % of the beams lie at the largest range, from {radius:.4g} {sequence.unit} on: no echo"
    points = np.where(mask[..., None], sequence.points, np.float32(0))
    return replace(sequence, mask=mask, points=points, notes=(*sequence.notes, Note(f"{path}: {found}")))


def _without_constant_odometry(sequence: ScanSequence, path: Path) -> ScanSequence:
    """Leaves out odometry with one pose for all scans, as logs of robots without odometry have it."""
    odometry = sequence.odometry_poses
    if odometry is None or len(odometry) < 2 or np.ptp(odometry, axis=0).any():
        return sequence
    note = Note(f"{path}: the odometry has the same pose at every scan; it is not used", is_doubt=True)
    return replace(sequence, odometry_poses=None, notes=(*sequence.notes, note))


def _check_beams(sequence: ScanSequence, path: Path, numbers: range) -> list[Note]:
    """Refuses scans of too few beams, or of no valid one; names few without an echo by their numbers in the file."""
    num_beams = sequence.mask.shape[1]
    advice = f"give {_LEAST_BEAMS} beams or more; arrays are (scans, beams, 2)"
    require(num_beams >= _LEAST_BEAMS, path, f"scans of {num_beams} beams", advice)
    empty = np.flatnonzero(~sequence.mask.any(axis=1)).tolist()
    first = [numbers[scan] for scan in empty[:1]]
    found = f"{len(empty)} of {len(sequence)} scans have no valid beam below the maximum range, the first is {first}"
    require(2 * len(empty) < len(sequence), path, found, "check the ranges, remove such scans, or choose others")
    points = sequence.points[np.arange(len(sequence)), sequence.mask.argmax(axis=1)]
    differ = (sequence.points != points[:, None]).any(axis=2) & sequence.mask
    require(differ.any(), path, "all points of each scan are one and the same", "give scans that see some surroundings")
    which = f"scan {first[0] if first else ''}"
    which = which if len(empty) == 1 else f"{len(empty)} scans, the first is {which}"
    return [Note(f"{path}: no echo in {which}; put between the scans before and after", is_doubt=True)] if empty else []


def _check_unit(sequence: ScanSequence, path: Path) -> list[Note]:
    """Refuses lengths that are impossible in the unit; returns a note on lengths that fit another unit better."""
    ranges = np.linalg.norm(sequence.points[sequence.mask].astype(np.float64), axis=1)
    median, (low, high), is_metric = float(np.median(ranges)), _PLAUSIBLE_RANGE[sequence.unit], sequence.unit == "m"
    advice = "convert millimetres to metres, or name the unit" if is_metric else "name the unit, or give pixels"
    require(low <= median <= high, path, f"the median range is {median:.4g} {sequence.unit}", advice)
    share = float((ranges < _USUAL_M).mean())
    found = f"{100 * share:.1f} % of the beams are below {_USUAL_M:g} m; are these millimetres or centimetres?"
    return [Note(f"{path}: {found}", is_doubt=True)] if is_metric and share < _LEAST_USUAL_SHARE else []


def read_arrays(path: str | Path, *, unit: Unit | None = None) -> ScanSequence:
    """Reads scans from `.npy` or `.npz`.

    A `.npy` holds points (n, b, 2) in the sensor frame; the third coordinate of (n, b, 3) is ignored. A `.npz` holds
    `points` like that, or `ranges` (n, b) with `angles` (b,) or (n, b) in radians counter-clockwise from straight
    ahead. Optional arrays are `mask` (n, b), `times` (n,) in seconds, and `unit`, "px" or "m". Also optional are
    `poses` (the reference) and `odometry`, as (n, 3) x, y, heading or (n, 3, 3) `T_world_scan`.

    Angles that span more than a turn are taken as degrees. A beam is invalid where `mask` is False, where both
    coordinates are NaN or 0, or where one is infinite. It is also invalid where its range is NaN, infinite or not
    positive, as scanner drivers write a beam without echo. A beam with one NaN coordinate and a finite one is an error.

    Args:
        path: the file.
        unit: unit of lengths; None takes the file's `unit`, and "m" where it has none.

    Returns:
        The sequence.

    Raises:
        InputError: the file is missing or damaged, lacks an array, has wrong shapes, or holds NaN or infinite values
            other than for invalid beams.
    """
    table, notes = load_arrays(path), tuple[Note, ...]()
    if "points" in table:
        points = _take_array(table, "points", (-1, -1, -1), path)
        require(points.shape[2] in (2, 3), path, f"points are {points.shape}", f"give {_KEYS}")
        heights = points[np.isfinite(points).all(axis=2) & points.any(axis=2)][:, 2:]
        is_planar = not heights.size or float(np.ptp(heights)) <= 1e-3
        found = "the third coordinates of the points differ"
        require(is_planar, path, found, "give planar scans, or 3-D scans to `dpmjax slam`")
        points = points[..., :2]
    else:
        points, notes = _points_of_ranges(table, path)
    n, b = points.shape[:2]
    mask = (np.isnan(points).sum(axis=2) < 2) & ~np.isinf(points).any(axis=2) & points.any(axis=2)
    if "mask" in table:
        mask &= _take_array(table, "mask", (n, b), path) != 0
    stored = np.where(mask[..., None], to_float32(points), np.float32(0))
    bad = np.argwhere(~np.isfinite(stored).all(axis=2))
    found = f"{len(bad)} NaN or infinite points, the first in scan, beam {bad[:1].tolist()}"
    require(not len(bad), path, found, "mark an invalid beam by NaN in both coordinates")
    times = _take_array(table, "times", (n,), path) if "times" in table else None
    require(times is None or np.isfinite(times).all(), path, "times that are not finite", "give finite seconds")
    stated = str(table.get("unit", "m"))
    require(stated in ("px", "m"), path, f"unit is {stated!r}", "say 'px' or 'm'")
    poses, odometry = (
        planar_rows(table[key], n, f"{path}: {key}") if key in table else None for key in ("poses", "odometry")
    )
    return ScanSequence(Path(path).stem, stored, mask, unit or cast(Unit, stated), poses, odometry, times, notes)


def _take_array(table: Table, key: str, shape: tuple[int, ...], path: str | Path) -> FloatArray:
    """Returns an array of numbers of this shape, in which -1 stands for any length."""
    require(key in table, path, f"no array {key} among {', '.join(table) or 'none'}", f"give {_KEYS}")
    array = table[key]
    fits = array.ndim == len(shape) and all(a in (-1, b) for a, b in zip(shape, array.shape, strict=True))
    is_good = fits and array.dtype.kind in ("biu" if key == "mask" else "fiu")
    require(is_good, path, f"{key} are {array.shape} {array.dtype}", f"give {_KEYS}")
    return array.astype(np.float64)


def _points_of_ranges(table: Table, path: str | Path) -> tuple[FloatArray, tuple[Note, ...]]:
    """Computes end points, NaN for beams without a hit, with a note where the angles are taken as degrees."""
    ranges = _take_array(table, "ranges", (-1, -1), path)
    is_one = table["angles"].ndim == 1 if "angles" in table else False
    angles = _take_array(table, "angles", ranges.shape[1:] if is_one else ranges.shape, path)
    found = "angles hold NaN, infinite or huge values"
    require((np.abs(angles) < 1e6).all(), path, found, "give a direction to every beam, in radians")
    notes: tuple[Note, ...] = ()
    if angles.size and np.ptp(angles, axis=-1).max() > _LARGEST_SPAN:
        angles, text = np.radians(angles), "the angles span more than one turn in radians; taken as degrees"
        notes = (Note(f"{path}: {text}", is_doubt=True),)
    ranges = np.where(np.isfinite(ranges) & (ranges > 0), ranges, np.nan)
    return ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1), notes


def read_deepmapping_folder(path: str | Path, *, unit: Unit | None = None) -> ScanSequence:
    """Reads a folder or an uncompressed or compressed tar archive of `*.pcd` and `gt_pose.mat`.

    Args:
        path: the folder, or the archive.
        unit: "px" (or None) multiplies coordinates by 512, as the authors' files need; "m" takes them unchanged, for
            other PCD scans.

    Returns:
        The scans in natural order of their names; scans with fewer points than the longest are padded with masked
        beams; reference poses where there is a `gt_pose.mat`.

    Raises:
        InputError: no such path, no PCD file, a damaged PCD file, a pose file that does not fit, or
            coordinates too large for their unit.
    """
    files = _list_files(Path(path))
    names = sorted((name for name in files if name.lower().endswith(".pcd")), key=natural_key)
    require(len(names) > 0, path, "no .pcd file in it", "give the authors' folder or .tar of .pcd files")
    scans = [parse_pcd(files[name], f"{path}/{name}").points[:, :2] for name in names]
    for scan in scans:
        scan[~np.isfinite(scan).all(axis=1) | (scan == 0).all(axis=1)] = np.nan
    points, mask = pad_scans(scans)
    largest = float(np.abs(points).max(initial=0.0))
    found = f"coordinates up to {largest:g}, too large for {unit or 'pixels / 512'}"
    is_small = largest <= (8.0 if unit is None else 1e7)
    require(is_small, path, found, "give pixels / 512, or name the unit m if they are metres")
    if unit != "m":
        # Coordinates of the authors' files are pixels / 512; their poses are pixels.
        points *= np.float32(512.0)
    reference = None
    for name in [name for name in files if PurePosixPath(name).name == "gt_pose.mat"][:1]:
        pose = np.asarray(load_mat(files[name], f"{path}/{name}").get("pose", np.zeros(0)))
        reference = planar_rows(pose, len(names), f"{path}/{name}: pose")
    return ScanSequence(Path(path).stem, points, mask, unit or "px", reference)


def _list_files(path: Path) -> dict[str, bytes]:
    """Reads the PCD and MAT files by name; archives are read in memory and never unpacked."""
    endings = (".pcd", ".mat")
    if path.is_dir():
        return {f.name: read_bytes(f) for f in path.iterdir() if f.name.lower().endswith(endings) and f.is_file()}
    # The parsers of tar, gzip, bzip2 and xz raise many kinds of errors.
    found, advice = "not a readable tar archive ({error})", "copy the archive again"
    with refusing(path, found, advice, (Exception,)), tarfile.open(path) as archive:
        members = [m for m in archive if m.isfile() and not m.issparse() and m.name.lower().endswith(endings)]
        members = [m for m in members if not PurePosixPath(m.name).name.startswith("._")]
        return {m.name: file.read() for m in members if (file := archive.extractfile(m)) is not None}

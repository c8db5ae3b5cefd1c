"""One checked 3-D scan of a file of any kind: metres, in the lidar's frame, without beams that have no hit.

The number of columns of a raw file of float32 is inferred from its name and its values.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.clouds import TimedCloud, parse_pcd, parse_ply
from dpmjax.io.files import import_for, load_arrays, log_notes, read_table, read_unpacked, refusing, to_float32
from dpmjax.sequences import EmptyScanError, FloatArray, InputError, Note, require

# Of equally many files of several endings the first is read; arrays may be labels, so they are last.
SCAN_SUFFIXES = (".pcd", ".ply", ".las", ".laz", ".bin", ".npz", ".npy", ".xyz")
# Columns x y z and more as text; in a folder such files may be poses or times.
_TEXT_SUFFIXES = (".xyz", ".csv", ".txt")
_TO_CONVERT = {
    ".pcap": "play it through the lidar's driver, or export PCD by its viewer",
    ".osf": "run: ouster-cli source FILE.osf save a.pcd",
    ".feather": "save the columns x y z: numpy.save('a.npy', pandas.read_feather(FILE)[['x', 'y', 'z']])",
    ".vtk": "export PLY by ParaView, or by meshio",
    ".e57": "export PLY or LAS by CloudCompare or PDAL",
}
_NPZ_KEYS, _NPZ_TIMES = ("lidar_pcd", "points", "xyz", "arr_0"), "times"
# Least range, usual range and largest range of lidars on the ground, m; nearly all points are within the usual range.
_NEAREST_M, _USUAL_M, _FARTHEST_M = 0.1, 120.0, 400.0
# LAZ packs a point of 20 bytes or more to 3, to less only where all points are alike; a record has 54 bytes or more.
_COLUMN_COUNTS, _USUAL_COLUMNS, _NUSCENES_COLUMNS = (3, 4, 5, 6, 7, 8), 4, 5
# NCLT packs a point to the 8 bytes of two float32: 5 mm from -100 m as uint16, intensity, and one of 32 lasers.
_NCLT_COLUMNS, _NCLT_RECORD, _NCLT_LASERS = 2, np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")]), 32


def read_lidar_file(path: str | Path, *, bin_columns: int | None = None) -> NDArray[np.float32]:
    """Reads one scan.

    A scan with hardly any point within 120 m, or with an unclear number of columns, is read with a warning.

    Args:
        path: a file of one of these formats. Binary rows: `.bin` (float32 x, y, z and more, as of KITTI; or NCLT's).
            NumPy: `.npy` (n, 3 or more) or `.npz` (key `lidar_pcd`, `points`, `xyz` or `arr_0`). Clouds: `.pcd`,
            `.ply`, `.las`, `.laz`. Columns of text: `.xyz`, `.csv`, `.txt`. All but `.npy` and `.npz` may be packed
            (`.gz`).
        bin_columns: numbers a point has in a `.bin` file: 4 with KITTI and MulRan, 5 with nuScenes; None
            infers it from the values.

    Returns:
        (n, 3) float32 x, y, z in the lidar's frame, m, without points at the origin and points that are not finite.

    Raises:
        InputError: names the file and the fault: missing, truncated, wrong columns, no points, no point in range,
            lengths in millimetres, or coordinates of a map such as UTM.
    """
    points = read_timed_cloud(Path(path), bin_columns).points
    log_notes(scan_notes(path, points, bin_columns=bin_columns))
    return points


def scan_notes(path: str | Path, points: NDArray[np.float32], *, bin_columns: int | None = None) -> list[Note]:
    """Lists the decisions about a file of one scan, and doubts.

    Args:
        path: the file.
        points: (n, 3) points of the file, m.
        bin_columns: value for the reader.

    Returns:
        Notes on the columns and on the unit.

    Raises:
        InputError: the file cannot be read any more.
    """
    is_raw = _suffix_of(Path(path)) == ".bin"
    columns = find_columns(Path(path), read_unpacked(path), bin_columns)[1] if is_raw else None
    return [note for note in (columns, unit_note(points, path)) if note is not None]


def read_point_times(path: str | Path) -> FloatArray | None:
    """Reads the times of the points of a scan.

    Args:
        path: a `.pcd` or `.ply` with a column t, time, timestamp, timestamps, time_stamp, time_offset or offset_time,
            a `.las` or `.laz` with GPS times, or a `.npz` with an array `times`.

    Returns:
        (n,) times of the points of `read_lidar_file`, in the unit and from the origin of the file; None where it has
        none, and for all other kinds of files.

    Raises:
        InputError: see `read_lidar_file`.
    """
    path = Path(path)
    return None if _suffix_of(path) == ".bin" else read_timed_cloud(path, None).times


def read_timed_cloud(path: Path, bin_columns: int | None) -> TimedCloud:
    """Reads points and times of a scan of any kind, checked; see `read_lidar_file`."""
    suffix = _suffix_of(path)
    require(not path.is_dir(), path, "a folder", "give one scan file")
    if suffix in (".npy", ".npz"):
        cloud = _read_arrays(path)
    elif suffix in _TEXT_SUFFIXES:
        table = read_table(path)
        require(table.shape[1] >= 3, path, f"rows of {table.shape[1]} numbers", "give rows of x y z")
        cloud = TimedCloud(to_float32(table[:, :3]), None)
    elif suffix == ".bin":
        content = read_unpacked(path)
        columns = bin_columns or find_columns(path, content)[0]
        check_size(path, len(content), columns)
        is_nclt = columns == _NCLT_COLUMNS
        points = _nclt_points(content) if is_nclt else np.frombuffer(content, "<f4").reshape(-1, columns)[:, :3]
        cloud = TimedCloud(points, None)
    else:
        parsers = {".pcd": parse_pcd, ".ply": parse_ply, ".las": _parse_las, ".laz": _parse_las}
        advice = _TO_CONVERT.get(suffix, f"give one of {' '.join(dict.fromkeys(SCAN_SUFFIXES + _TEXT_SUFFIXES))}")
        require(suffix in parsers, path, f"an unknown kind of scan, {suffix or 'without ending'}", advice)
        cloud = parsers[suffix](read_unpacked(path), str(path))
    return check_scan(cloud, path)


def _suffix_of(path: Path) -> str:
    """Returns the ending of a file in small letters, of a packed one the ending before .gz."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def _read_arrays(path: Path) -> TimedCloud:
    """Reads points and times of a NumPy file."""
    table = load_arrays(path, None if path.suffix.lower() == ".npy" else (*_NPZ_KEYS, _NPZ_TIMES))
    values = next((table[key] for key in _NPZ_KEYS if key in table), np.zeros(0))
    found = f"an array of {values.shape} {values.dtype}" if values.size else "no array of points"
    is_good = values.ndim in (2, 3) and values.shape[-1] >= 3 and values.dtype.kind in "fiu"
    # An array of few rows and many columns has the coordinates in its rows.
    is_good = is_good and not (values.ndim == 2 and len(values) < 16 < values.shape[1])
    advice = f"give points (n, 3), or organised (rows, columns, 3), in metres, as one of {', '.join(_NPZ_KEYS)}"
    require(is_good, path, found, advice)
    points, times = values.reshape(-1, values.shape[-1])[:, :3], table.get(_NPZ_TIMES)
    if times is not None:
        fits = times.shape in (values.shape[:-1], points.shape[:1]) and times.dtype.kind in "fiu"
        found = f"times {times.shape} {times.dtype} of {len(points)} points"
        require(fits, path, found, "give one time a point")
        times = times.astype(np.float64).ravel()
    return TimedCloud(to_float32(points), times)


def _parse_las(content: bytes, source: str) -> TimedCloud:
    """Reads the points of a LAS or LAZ file by laspy (extra `las`), with GPS times where the point format has them."""
    laspy = import_for(source, "laspy", "las")
    options = {"laz_backend": (laspy.LazBackend.Lazrs,), "read_evlrs": False}
    found, advice = (
        "not a readable LAS file ({kind}: {error})",
        "copy the file again, or save it anew as LAS 1.2 or 1.4",
    )
    # Damaged headers raise many kinds of errors.
    with refusing(source, found, advice, (Exception,)), np.errstate(all="ignore"):
        try:
            header_size, start, num_records = struct.unpack_from("<HII", content, 94)
            if content[:4] != b"LASF" or not header_size + num_records * 54 <= start <= len(content):
                raise ValueError("no LAS header, or more records than bytes before the points")
            with laspy.open(io.BytesIO(content), **options) as reader:
                _require_points(reader.header, content)
                cloud = reader.read()
        except BaseException as error:
            # A panic of the decompressor, which is written in Rust, is no Exception.
            if type(error).__name__ == "PanicException":
                raise ValueError(str(error)) from error
            raise
        has_times = "gps_time" in cloud.point_format.dimension_names
        points = to_float32(np.stack([cloud.x, cloud.y, cloud.z], axis=1))
        return TimedCloud(points, np.asarray(cloud.gps_time, np.float64) if has_times else None)


def _require_points(header: Any, content: bytes) -> None:
    """Raises a ValueError where a file is shorter than its header says, or has no table of its compressed chunks."""
    start, size, count = int(header.offset_to_point_data), len(content), int(header.point_count)
    is_good = start + count * int(header.point_format.size) <= size
    if header.are_points_compressed:
        # The decompressor reserves memory by the number in the table, and ends the process where it fails.
        (place,) = struct.unpack_from("<q", content, start)
        (place,) = struct.unpack_from("<q", content, size - 8) if place == -1 else (place,)
        version, num_chunks = struct.unpack_from("<II", content, place) if 0 < place <= size - 8 else (1, 0)
        # LAZ packs a point of 20 bytes or more to 3, to less only where all points are alike.
        is_good = count <= 100 * size and version == 0 and num_chunks <= size
    if not is_good:
        raise ValueError(f"truncated: {count} points, {size} bytes are there")


def check_scan(cloud: TimedCloud, source: str | Path) -> TimedCloud:
    """Refuses points that are no scan in metres, and removes beams without a hit.

    Args:
        cloud: points of a file.
        source: source for messages.

    Returns:
        The points, float32, that are finite and not at the origin, with their times.

    Raises:
        EmptyScanError: no beam has a hit.
        InputError: see `read_lidar_file`.
    """
    points, times = cloud
    # Three products are much faster than `numpy.linalg.norm`.
    with np.errstate(invalid="ignore"):
        x, y, z = points.astype(np.float64).T
    squared = x * x + y * y + z * z
    is_kept = np.isfinite(squared) & (squared > 0)
    kept = points.take(np.flatnonzero(is_kept), axis=0)
    if not len(kept):
        why = f": all {len(points)} are zero or not finite" if len(points) else ""
        raise EmptyScanError(source, f"no point in the scan{why}", "remove the file, or copy it again")
    ranges = np.sqrt(squared[is_kept])
    # A sample of the points suffices for medians.
    some = slice(None, None, max(1, len(kept) // 4096))
    median_m = float(np.median(ranges[some]))
    found, advice = f"the median range is {median_m:.4g} m", "convert millimetres or centimetres to metres"
    if _is_far_place(kept[some].astype(np.float64)):
        at = " ".join(f"{value:.0f}" for value in np.median(kept, axis=0))
        found = f"{found}, around one place far away: coordinates of a map, such as UTM"
        advice = f"subtract an origin such as {at}, and give points in the lidar's own frame"
    elif median_m > 1000 * _FARTHEST_M:
        advice = "check the number of columns, and that they are float32"
    require(median_m <= _FARTHEST_M, source, found, advice)
    is_near = ((ranges > _NEAREST_M) & (ranges < _FARTHEST_M)).any()
    require(is_near, source, f"all {len(kept)} points are out of range", "give metres in the lidar's own frame")
    return TimedCloud(np.ascontiguousarray(kept, np.float32), None if times is None else times[is_kept])


def unit_note(points: NDArray[np.float32], source: str | Path) -> Note | None:
    """Returns a note on a doubtful unit where hardly any point is within the usual range.

    Args:
        points: (n, 3), m.
        source: source for the note.

    Returns:
        The note, or None.
    """
    share = float((np.linalg.norm(points.astype(np.float64), axis=1) < _USUAL_M).mean()) if len(points) else 1.0
    if share >= 0.05:
        return None
    found = f"{100 * share:.1f} % of the points lie within {_USUAL_M:g} m"
    what = "coordinates of a map" if _is_far_place(points) else "millimetres or centimetres"
    return Note(f"{source}: {found}; are these {what}?", is_doubt=True)


def _is_far_place(points: NDArray[Any]) -> bool:
    """Returns True for points around one place far from the origin."""
    middle = np.median(points, axis=0)
    # Points in map coordinates are five times as near to their middle as to the origin.
    return bool(np.median(np.linalg.norm(points - middle, axis=1)) * 5.0 < np.linalg.norm(middle))


def find_columns(path: Path, content: bytes, given: int | None = None) -> tuple[int, Note | None]:
    """Infers the number of columns of a raw file, or compares a given one with the values.

    The correct layout has values of one kind in each column, and a wrong one mixes them. So the layout with the largest
    mutual information of column and value is taken. `.pcd.bin` files, as those of nuScenes, have five columns unless
    the values contradict.

    Args:
        path: the file.
        content: its bytes.
        given: number of columns; None infers it.

    Returns:
        The number of values of each point (x, y and z first), and a note. There is a note if the number is not KITTI's
        four, if the values fit another number as well, or if they contradict the given one.

    Raises:
        InputError: the file holds float64, and no layout is given.
    """
    if given is None and _is_nclt(content):
        return _NCLT_COLUMNS, Note(f"{path}: points of 8 bytes, as of NCLT; y and z are turned, so that z is up")
    # Bins hold 50 values or more.
    values = np.frombuffer(content[: len(content) // 4 * 4], "<f4")[:60_000]
    are_doubles = given is None and _are_doubles(values)
    require(not are_doubles, path, "the values are float64", "save them as float32, or the points as .npy")
    inferred = _columns_by_values(values)
    if given is not None:
        text = f"{path}: --columns {given}, but the values look like {inferred} columns a point"
        return given, None if inferred in (None, given) else Note(text, is_doubt=True)
    fitting = [n for n in _COLUMN_COUNTS if len(content) % (4 * n) == 0]
    is_nuscenes = inferred is None and path.name.lower().endswith(".pcd.bin") and _NUSCENES_COLUMNS in fitting
    columns = inferred or (_NUSCENES_COLUMNS if is_nuscenes else _USUAL_COLUMNS)
    others = " or ".join(str(n) for n in fitting if n != columns)
    if columns != _USUAL_COLUMNS:
        how = "by its ending" if is_nuscenes else "inferred from the values"
        return columns, Note(f"{path}: {columns} columns a point, {how}; --columns decides")
    text = f"{path}: 4 columns a point are assumed, {others} would fit as well; --columns decides"
    return columns, Note(text, is_doubt=True) if inferred is None and others and content else None


def _is_nclt(content: bytes) -> bool:
    """Returns True for points of 8 bytes; as float32, the last of them is a sign and most of an exponent."""
    lasers = np.frombuffer(content[: len(content) // 8 * 8], _NCLT_RECORD)["laser"]
    return len(lasers) > 0 and bool((lasers < _NCLT_LASERS).all()) and len(np.unique(lasers)) > _NCLT_LASERS // 4


def _nclt_points(content: bytes) -> NDArray[np.float32]:
    """Returns points with z up; those of NCLT have y to the right and z down."""
    points = 0.005 * np.frombuffer(content, _NCLT_RECORD)["xyz"].astype(np.float32) - 100.0
    return points * np.array([1, -1, -1], np.float32)


def check_size(path: str | Path, size: int, columns: int) -> None:
    """Refuses a raw file whose size in bytes is no whole number of points: it is cut off, or has other columns."""
    found = f"{size} bytes are no whole number of points of {columns} float32: truncated, or other columns"
    others = [str(n) for n in _COLUMN_COUNTS if size % (4 * n) == 0]
    advice = "copy the file again" + (f", or say --columns {' or '.join(others)}" if others else "")
    require(size % (4 * columns) == 0, path, found, advice)


def columns_of_drive(files: Iterable[Path], given: int | None = None) -> tuple[int, Note | None]:
    """Infers or compares the columns of raw files by the first one that can be read; KITTI's where none can."""
    for file in files:
        content = b""
        # One that cannot be read is named when it is read.
        with contextlib.suppress(InputError):
            content = read_unpacked(file) if file.suffix.lower() == ".bin" else b""
        if content:
            return find_columns(file, content, given)
    return given or _USUAL_COLUMNS, None


def _are_doubles(values: NDArray[np.float32]) -> bool:
    """Returns True for coordinates in float64, whose lower halves are bits without a meaning."""
    halves = values[: len(values) // 2 * 2]
    doubles = halves.view("<f8")

    def usual_share(numbers: NDArray[np.floating]) -> float:
        with np.errstate(invalid="ignore"):
            sizes = np.abs(numbers[doubles != 0])
            return float(((sizes > 1e-4) & (sizes < 1e5)).sum() / max(len(sizes), 1))

    return usual_share(doubles) >= 0.95 and usual_share(halves[::2]) <= 0.7


def _columns_by_values(values: NDArray[np.float32]) -> int | None:
    """Finds the layout of the largest mutual information of column and value; None where no layout stands out."""
    num_bins = min(64, len(values) // (50 * max(_COLUMN_COUNTS)))
    if num_bins < 4:
        return None
    with np.errstate(invalid="ignore"):
        finite = np.nan_to_num(values.astype(np.float64))
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, num_bins + 1)[1:-1]))
    bins = np.searchsorted(edges, finite, side="right")
    bits = {n: _information_bits(bins, n, len(edges) + 1) for n in _COLUMN_COUNTS}
    # Six and eight columns repeat the order of three and four, so their information must be larger by this ratio.
    layouts = [n for n in _COLUMN_COUNTS if n not in (6, 8) or bits[n] >= 1.1 * bits[n // 2]]
    best, second, *_ = sorted(layouts, key=lambda n: -bits[n])
    # The best layout stands out by its bits, and by their ratio to the next one.
    return best if bits[best] >= max(0.05, 1.3 * bits[second]) else None


def _information_bits(bins: NDArray[np.int64], columns: int, num_bins: int) -> float:
    """Computes the mutual information of value and column, corrected for few samples (Miller and Madow 1955)."""
    rows = bins[: len(bins) // columns * columns].reshape(-1, columns)
    counts = np.stack([np.bincount(column, minlength=num_bins) for column in rows.T]).astype(np.float64)
    joint = counts / counts.sum()
    independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    is_there = joint > 0
    bits = (joint[is_there] * np.log2(joint[is_there] / independent[is_there])).sum()
    return float(bits - (num_bins - 1) * (columns - 1) / (2 * np.log(2) * counts.sum()))

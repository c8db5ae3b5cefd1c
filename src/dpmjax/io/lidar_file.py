"""One checked 3-D scan of a file of any kind: metres, in the lidar's frame, without beams that have no hit.

The number of columns of a raw file of float32 is inferred from its name and its values.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.clouds import TimedCloud, parse_pcd, parse_ply
from dpmjax.io.files import import_for, load_arrays, log_notes, read_bytes, refusing, to_float32
from dpmjax.sequences import EmptyScanError, FloatArray, InputError, Note, require

# Of equally many files of several endings the first is read; arrays may be labels, so they are last.
SCAN_SUFFIXES = (".pcd", ".ply", ".las", ".laz", ".bin", ".npz", ".npy")
_NPZ_KEYS, _NPZ_TIMES = ("lidar_pcd", "points", "xyz", "arr_0"), "times"
# Least range, usual range and largest range of lidars on the ground, m; nearly all points are within the usual range.
_NEAREST_M, _USUAL_M, _FARTHEST_M = 0.1, 120.0, 400.0
_LEAST_USUAL_SHARE = 0.05
# An array of fewer rows and more columns than this has the coordinates in its rows.
_MOST_ROWS_OF_TRANSPOSE = 16
# Points in map coordinates are nearer to their middle than to the origin by this factor.
_MAP_RATIO = 5.0
_LAS_ADVICE = "copy the file again, or save it anew as LAS 1.2 or 1.4"
# LAZ packs a point of 20 bytes or more to 3, and to less only where all points are alike.
_MOST_POINTS_PER_BYTE = 100
# The least length of a variable length record.
_RECORD_BYTES = 54
# Types of the compressed items of a point with fixed lengths, in bytes; byte items have any length.
_ITEM_BYTES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
_BYTE_ITEMS = (0, 14)
_COLUMN_COUNTS = (3, 4, 5, 6, 7, 8)
_USUAL_COLUMNS = 4
_NUSCENES_ENDING, _NUSCENES_COLUMNS = ".pcd.bin", 5
# Largest number of values, largest number of bins of their histogram, and least number of values of a bin.
_MOST_VALUES, _MOST_BINS, _LEAST_PER_BIN = 60_000, 64, 50
# Mutual information of column and value: least value of the best layout, bits, and least ratio to the next layout.
_LEAST_BITS, _LEAST_RATIO = 0.05, 1.3
# Six and eight columns repeat the order of three and four, so their information must be larger by this ratio.
_DOUBLED_RATIO = 1.1
# Usual magnitudes of coordinates, least share of such float64, and largest share of their lower halves as float32.
_USUAL_SIZES, _LEAST_DOUBLES, _MOST_HALVES = (1e-4, 1e5), 0.95, 0.7


def read_lidar_file(path: str | Path, *, bin_columns: int | None = None) -> NDArray[np.float32]:
    """Reads one scan.

    A scan with hardly any point within 120 m, or with an unclear number of columns, is read with a warning.

    Args:
        path: `.bin` (float32 rows of x, y, z and more, as of KITTI), `.npy` (n, 3 or more), `.npz` (key `lidar_pcd`,
            `points`, `xyz` or `arr_0`), `.pcd`, `.ply`, `.las` or `.laz`.
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
    path = Path(path)
    is_raw = path.suffix.lower() == ".bin"
    columns = find_columns(path, read_bytes(path), bin_columns).note if is_raw else None
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
    return None if path.suffix.lower() in (".bin", ".npy") else read_timed_cloud(path, None).times


def read_timed_cloud(path: Path, bin_columns: int | None) -> TimedCloud:
    """Reads points and times of a scan of any kind, checked; see `read_lidar_file`."""
    suffix = path.suffix.lower()
    require(not path.is_dir(), path, "a folder", "give one scan file")
    found = f"an unknown kind of scan, {suffix or 'without ending'}"
    require(suffix in SCAN_SUFFIXES, path, found, f"give one of {' '.join(SCAN_SUFFIXES)}")
    if suffix == ".bin":
        cloud = TimedCloud(_read_bin(path, bin_columns), None)
    elif suffix in (".npy", ".npz"):
        cloud = _read_arrays(path)
    else:
        parse = {".pcd": parse_pcd, ".ply": parse_ply}.get(suffix, _parse_las)
        cloud = parse(read_bytes(path), str(path))
    return check_scan(cloud, path)


def _read_arrays(path: Path) -> TimedCloud:
    """Reads points and times of a NumPy file."""
    table = load_arrays(path, None if path.suffix.lower() == ".npy" else (*_NPZ_KEYS, _NPZ_TIMES))
    values = next((table[key] for key in _NPZ_KEYS if key in table), None)
    if values is None:
        raise InputError(path, "no array of points", f"call it one of {', '.join(_NPZ_KEYS)}")
    is_good = values.ndim in (2, 3) and values.shape[-1] >= 3 and values.dtype.kind in "fiu"
    found = f"an array of {values.shape} {values.dtype}"
    is_good = is_good and not (values.ndim == 2 and len(values) < _MOST_ROWS_OF_TRANSPOSE < values.shape[1])
    require(is_good, path, found, "give points (n, 3), or organised (rows, columns, 3): x, y and z in metres")
    points = values.reshape(-1, values.shape[-1])
    times = None
    if _NPZ_TIMES in table:
        column = table[_NPZ_TIMES]
        found = f"times {column.shape} {column.dtype} of {len(points)} points"
        fits = column.shape in (values.shape[:-1], points.shape[:1]) and column.dtype.kind in "fiu"
        require(fits, path, found, "give one time a point")
        times = np.asarray(column, np.float64).ravel()
    return TimedCloud(to_float32(points[:, :3]), times)


def _parse_las(content: bytes, source: str) -> TimedCloud:
    """Reads the points of a LAS or LAZ file by laspy (extra `las`), with GPS times where the point format has them."""
    laspy = import_for(source, "laspy", "las")
    require(content[:4] == b"LASF", source, "no LAS header", _LAS_ADVICE)
    options = {"laz_backend": (laspy.LazBackend.Lazrs,), "read_evlrs": False}
    try:
        # Damaged headers raise many kinds of errors.
        with refusing(source, "not a readable LAS file ({kind}: {error})", _LAS_ADVICE, (Exception,)):
            header_size, start, num_records = struct.unpack_from("<HII", content, 94)
            if not header_size + num_records * _RECORD_BYTES <= start <= len(content):
                found = f"{num_records} records before the points, which begin at byte {start} of {len(content)}"
                raise ValueError(found)
            with np.errstate(all="ignore"), laspy.open(io.BytesIO(content), **options) as reader:
                _require_whole(reader.header, content)
                cloud = reader.read()
                points = to_float32(np.stack([cloud.x, cloud.y, cloud.z], axis=1))
                has_times = "gps_time" in cloud.point_format.dimension_names
                return TimedCloud(points, np.asarray(cloud.gps_time, np.float64) if has_times else None)
    except BaseException as error:
        # A panic of the decompressor, which is written in Rust, is no Exception.
        if type(error).__name__ == "PanicException":
            raise InputError(source, f"not a readable LAS file ({error})", _LAS_ADVICE) from error
        raise


def _require_whole(header: Any, content: bytes) -> None:
    """Raises a ValueError where a file is shorter than its header says, or its compression is damaged."""
    count, size = int(header.point_count), len(content)
    start, width = int(header.offset_to_point_data), int(header.point_format.size)
    is_packed = header.are_points_compressed
    if not (count <= _MOST_POINTS_PER_BYTE * size if is_packed else start + count * width <= size):
        raise ValueError(f"truncated: {count} points, {size} bytes are there")
    if not is_packed:
        return
    # The decompressor reserves memory by the number in the table of chunks, and ends the process where it fails.
    (place,) = struct.unpack_from("<q", content, start)
    (place,) = struct.unpack_from("<q", content, size - 8) if place == -1 else (place,)
    version, num_chunks = struct.unpack_from("<II", content, place) if 0 < place <= size - 8 else (1, 0)
    if version != 0 or num_chunks > size:
        raise ValueError("no table of its compressed chunks")
    record = header.vlrs.get("LasZipVlr")[0].record_data
    (num_items,) = struct.unpack_from("<H", record, 32)
    items = [struct.unpack_from("<HH", record, 34 + 6 * i) for i in range(num_items)]
    is_known = all(wide == _ITEM_BYTES.get(kind, wide if kind in _BYTE_ITEMS else None) for kind, wide in items)
    if not items or not is_known or sum(wide for _, wide in items) != width:
        raise ValueError(f"points of {width} bytes in compressed items {items}")


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
    is_kept = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    kept = points[is_kept].astype(np.float64)
    if not len(kept):
        why = f": all {len(points)} are zero or not finite" if len(points) else ""
        raise EmptyScanError(source, f"no point in the scan{why}", "remove the file, or copy it again")
    ranges = np.linalg.norm(kept, axis=1)
    median = float(np.median(ranges))
    require(median <= _FARTHEST_M, source, *_why_too_far(kept, median))
    is_near = ((ranges > _NEAREST_M) & (ranges < _FARTHEST_M)).any()
    require(is_near, source, f"all {len(kept)} points are out of range", "give metres in the lidar's own frame")
    return TimedCloud(np.ascontiguousarray(kept, np.float32), None if times is None else times[is_kept])


def _why_too_far(points: FloatArray, median: float) -> tuple[str, str]:
    """Returns finding and advice for a too large median range: map coordinates, another unit, or garbage."""
    found = f"the median range is {median:.4g} m"
    if _is_far_place(points):
        at = " ".join(f"{value:.0f}" for value in np.median(points, axis=0))
        advice = f"subtract an origin such as {at}, and give points in the lidar's own frame"
        return f"{found}, around one place far away: coordinates of a map, such as UTM", advice
    is_unit = median < 1000 * _FARTHEST_M
    return found, "convert millimetres or centimetres to metres" if is_unit else "check the number of columns"


def unit_note(points: NDArray[np.float32], source: str | Path) -> Note | None:
    """Returns a note on a doubtful unit where hardly any point is within the usual range.

    Args:
        points: (n, 3), m.
        source: source for the note.

    Returns:
        The note, or None.
    """
    share = float((np.linalg.norm(points.astype(np.float64), axis=1) < _USUAL_M).mean()) if len(points) else 1.0
    if share >= _LEAST_USUAL_SHARE:
        return None
    found = f"{100 * share:.1f} % of the points lie within {_USUAL_M:g} m"
    what = "coordinates of a map" if _is_far_place(points) else "millimetres or centimetres"
    return Note(f"{source}: {found}; are these {what}?", is_doubt=True)


def _is_far_place(points: NDArray[Any]) -> bool:
    """Returns True for points around one place far from the origin."""
    middle = np.median(points, axis=0)
    return bool(np.median(np.linalg.norm(points - middle, axis=1)) * _MAP_RATIO < np.linalg.norm(middle))


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


def find_columns(path: Path, content: bytes, given: int | None = None) -> Columns:
    """Infers the columns of a raw file, or compares given ones with the values.

    The correct layout has values of one kind in each column, and a wrong one mixes them. So the layout with the largest
    mutual information of column and value is taken. `.pcd.bin` files, as those of nuScenes, have five columns unless
    the values contradict.

    Args:
        path: the file.
        content: its bytes.
        given: number of columns; None infers it.

    Returns:
        The layout, with a note where it is not KITTI's, where the values fit another as well, or where they contradict
        the given one.

    Raises:
        Float64Error: the file holds float64, and no layout is given.
        InputError: the file has no whole number of points of the layout, or of any.
    """
    fitting = [n for n in _COLUMN_COUNTS if len(content) % (4 * n) == 0]
    values = np.frombuffer(content[: len(content) // 4 * 4], "<f4")
    inferred = _columns_by_values(values)
    if given is not None:
        text = f"{path}: --columns {given}, but the values look like {inferred} columns a point"
        return Columns(given, None if inferred in (None, given) else Note(text, is_doubt=True))
    if _are_doubles(values):
        raise Float64Error(path, "the values are float64", "save them as float32, or the points as .npy")
    is_nuscenes = path.name.lower().endswith(_NUSCENES_ENDING)
    if inferred is None and is_nuscenes and _NUSCENES_COLUMNS in fitting:
        return Columns(_NUSCENES_COLUMNS, Note(f"{path}: 5 columns a point, by its ending; --columns decides"))
    check_size(path, len(content), inferred or _USUAL_COLUMNS)
    if inferred is not None:
        text = f"{path}: {inferred} columns a point, inferred from the values; --columns decides"
        return Columns(inferred, None if inferred == _USUAL_COLUMNS else Note(text))
    others = " or ".join(str(n) for n in fitting if n != _USUAL_COLUMNS)
    text = f"{path}: 4 columns a point are assumed, {others} would fit as well; --columns decides"
    return Columns(_USUAL_COLUMNS, Note(text, is_doubt=True) if others and content else None)


def check_size(path: str | Path, size: int, columns: int) -> None:
    """Refuses a raw file whose size in bytes is no whole number of points: it is cut off, or has other columns."""
    found = f"{size} bytes are no whole number of points of {columns} float32: truncated, or other columns"
    others = [str(n) for n in _COLUMN_COUNTS if n != columns and size % (4 * n) == 0]
    advice = "copy the file again" + (f", or say --columns {' or '.join(others)}" if others else "")
    require(size % (4 * columns) == 0, path, found, advice)


def _read_bin(path: Path, columns: int | None) -> NDArray[np.float32]:
    """Reads x, y and z (n, 3) of a raw file; None infers the number of columns from the values."""
    content = read_bytes(path)
    if columns is None:
        columns = find_columns(path, content).num_columns
    check_size(path, len(content), columns)
    return np.frombuffer(content, "<f4").reshape(-1, columns)[:, :3]


def columns_of_drive(files: Iterable[Path], given: int | None = None) -> Columns:
    """Infers or compares the columns of raw files by the first one that can be read; KITTI's where none can."""
    for file in files:
        if file.suffix.lower() != ".bin":
            break
        try:
            content = read_bytes(file)
            if content:
                return find_columns(file, content, given)
        except Float64Error:
            raise
        except InputError:  # named where it is read
            continue
    return Columns(given or _USUAL_COLUMNS)


def _are_doubles(values: NDArray[np.float32]) -> bool:
    """Returns True for coordinates in float64, whose lower halves are bits without a meaning."""
    halves = values[: min(len(values), _MOST_VALUES) // 2 * 2]
    doubles = halves.view("<f8")
    is_there = doubles != 0
    if not is_there.any():
        return False
    with np.errstate(invalid="ignore"):
        shares = [
            float(((_USUAL_SIZES[0] < np.abs(numbers)) & (np.abs(numbers) < _USUAL_SIZES[1])).mean())
            for numbers in (doubles[is_there], halves[::2][is_there])
        ]
    return shares[0] >= _LEAST_DOUBLES and shares[1] <= _MOST_HALVES


def _columns_by_values(values: NDArray[np.float32]) -> int | None:
    """Finds the layout of the largest mutual information of column and value; None where no layout stands out."""
    values = values[:_MOST_VALUES]
    num_bins = min(_MOST_BINS, len(values) // (_LEAST_PER_BIN * max(_COLUMN_COUNTS)))
    if num_bins < 4:
        return None
    with np.errstate(invalid="ignore"):
        finite = np.nan_to_num(values.astype(np.float64))
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, num_bins + 1)[1:-1]))
    bins = np.searchsorted(edges, finite, side="right")
    bits = {n: _information_bits(bins, n, len(edges) + 1) for n in _COLUMN_COUNTS}
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

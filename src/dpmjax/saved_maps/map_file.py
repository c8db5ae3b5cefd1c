"""Saved maps: one `.npz` file of plain arrays, checked on load.

Ragged arrays are concatenated, with the number of rows of each keyframe. `header` is JSON in UTF-8: format, version,
precision, fingerprint of the weights, and the settings of SLAM.
"""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import get_args

import numpy as np

from dpmjax.io.files import load_arrays, refusing, write_atomically
from dpmjax.saved_maps.map_arrays import Arrays, Precision, pack_map, unpack_map
from dpmjax.sequences import InputError, require
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.keyframe_map import KeyframeMap, MapOrigin
from dpmjax.slam.map_thinning import thin_map
from dpmjax.weights.config_json import config_from_json

FORMAT, VERSION = "dpmjax map", 3
# Smaller than the spacing of consecutive keyframes, so that only keyframes of other laps are left out.
SPACING_SHARE = 0.2

ADVICE = "save it again with dpmjax.save_map"


def save_map(
    path: str | Path, slam_map: KeyframeMap, precision: Precision = "float32", *, spacing_share: float | None = None
) -> Path:
    """Writes a map to a file that `load_map` reads; an interruption never leaves half a file.

    Args:
        path: must end in `.npz`; an existing file is replaced.
        slam_map: map of a run, `result.map`, with at least one keyframe.
        precision: with "float32" the file is exact: a run that continues from it equals an unbroken one. With "int8" it
            is smallest, for localisation: it rounds features and elements to codes, keeps 256 elements a keyframe, and
            omits keyframes that those of other laps cover (`slam.thin_map`).
        spacing_share: keyframes nearer to others than this share of their extent are left out; 0 keeps all. None takes
            0.2 for "int8" and 0 for "float32".

    Returns:
        The path.

    Raises:
        ValueError: if the path has another ending, the precision is unknown, or the map is empty.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"path: expected a file that ends in .npz, got {str(path)!r}")
    return write_atomically(path, map_bytes(slam_map, precision, spacing_share=spacing_share))


def map_bytes(slam_map: KeyframeMap, precision: Precision = "float32", *, spacing_share: float | None = None) -> bytes:
    """Makes the content of the file of a map; its length is the cost of the map.

    Args:
        slam_map: see `save_map`.
        precision: see `save_map`.
        spacing_share: see `save_map`.

    Returns:
        The bytes.

    Raises:
        ValueError: if the precision is unknown or the map is empty.
    """
    if precision not in get_args(Precision):
        raise ValueError(f"precision: expected one of {', '.join(get_args(Precision))}, got {precision!r}")
    if spacing_share is None:
        spacing_share = SPACING_SHARE if precision == "int8" else 0.0
    if spacing_share != 0:
        slam_map = thin_map(slam_map, spacing_share=spacing_share)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, array in map_arrays(slam_map, precision).items():
            # LZMA makes codes a sixth smaller, but is slow; a mask of equal values would look like a ZIP bomb.
            is_code = precision == "int8" and array.dtype != bool
            stored = io.BytesIO()
            np.save(stored, array, allow_pickle=False)
            # A `ZipInfo` has no time of writing: equal maps are equal files.
            member = zipfile.ZipInfo(f"{name}.npy")
            archive.writestr(member, stored.getvalue(), zipfile.ZIP_LZMA if is_code else zipfile.ZIP_DEFLATED)
    return content.getvalue()


def map_arrays(slam_map: KeyframeMap, precision: Precision) -> Arrays:
    """Makes the arrays of the file of a map.

    Args:
        slam_map: map with at least one keyframe.
        precision: see `save_map`.

    Returns:
        The arrays by name, the header among them.

    Raises:
        ValueError: if the map is empty.
    """
    origin = slam_map.origin
    if origin is None:
        raise ValueError("slam_map: expected keyframes, got an empty map")
    header = {
        "format": FORMAT,
        "version": VERSION,
        "precision": precision,
        "fingerprint": origin.fingerprint,
        "weights": origin.weights,
        "config": dataclasses.asdict(origin.config),
    }
    named: Arrays = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    return named | pack_map(slam_map, precision)


def load_map(path: str | Path) -> KeyframeMap:
    """Reads a map that `save_map` wrote.

    Args:
        path: the file.

    Returns:
        The map.

    Raises:
        InputError: no such file, no map, one of a newer version, or a damaged one.
    """
    try:
        arrays = load_arrays(path)
    except InputError as error:
        advice = "give a file of dpmjax.save_map" if Path(path).exists() else error.advice
        raise InputError(path, error.found, advice) from error
    return map_of_arrays(path, arrays)


def map_of_arrays(path: str | Path, arrays: Arrays) -> KeyframeMap:
    """Makes a map of the arrays of a file.

    Args:
        path: path of the file, for messages.
        arrays: arrays from `map_arrays`; others may be among them.

    Returns:
        The map.

    Raises:
        InputError: no map, one of another version, or a damaged one.
    """
    require("header" in arrays, path, "a NumPy file, but not one of a dpmjax map", "give a file of dpmjax.save_map")
    with refusing(path, "its header cannot be read ({error})", ADVICE, (Exception,)):
        header = json.loads(arrays["header"].tobytes())
        found, version, precision = header["format"], header["version"], header["precision"]
        fingerprint, weights = str(header["fingerprint"]), str(header["weights"])
    require(found == FORMAT, path, "not a dpmjax map", "give a file of dpmjax.save_map")
    advice = "update dpmjax" if version > VERSION else "map the drive again"
    require(version == VERSION, path, f"format version {version}, this dpmjax reads {VERSION}", advice)
    require(precision in get_args(Precision), path, f"precision {precision}", ADVICE)
    with refusing(path, "{error}", ADVICE, (ValueError, TypeError)):
        origin = MapOrigin(fingerprint, config_from_json(header["config"], SlamConfig, file=path), weights)
    for name, array in arrays.items():
        is_good = array.dtype.kind in "iub" or (array.dtype.kind == "f" and bool(np.isfinite(array).all()))
        require(is_good, path, f"{name} holds values that are not finite numbers", ADVICE)
    with refusing(path, "damaged: {error}", ADVICE, (Exception,)):
        return unpack_map(arrays, precision, origin)

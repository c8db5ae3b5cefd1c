"""The DeepMapping authors' layout of a 2-D trajectory: one PCD file per scan, and gt_pose.mat beside them.

Coordinates in the PCD files are pixels / 512, poses are pixels and radians; an invalid beam is a point of
zeros, or one that is not finite.
"""

from __future__ import annotations

import tarfile
from pathlib import Path, PurePosixPath

import numpy as np

from dpmjax.io.clouds import parse_pcd
from dpmjax.io.files import load_mat, natural_key, read_bytes, refusing
from dpmjax.io.poses import planar_rows
from dpmjax.sequences import ScanSequence, Unit, pad_scans, require

_PIXELS_PER_UNIT = 512.0
_LARGEST_STORED = 8.0  # A picture of 2048 pixels has a diagonal of 5.7 stored units.
_LARGEST_LENGTH = 1e7
_SUFFIXES = (".pcd", ".mat")
_POSE_FILE = "gt_pose.mat"


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
    is_small = largest <= (_LARGEST_STORED if unit is None else _LARGEST_LENGTH)
    require(is_small, path, found, "give pixels / 512, or name the unit m if they are metres")
    if unit != "m":
        points *= np.float32(_PIXELS_PER_UNIT)
    source = next((name for name in files if PurePosixPath(name).name == _POSE_FILE), None)
    reference = None
    if source is not None:
        variables = load_mat(files[source], f"{path}/{source}")
        found = f"variables are {', '.join(variables) or 'none'}"
        require("pose" in variables, f"{path}/{source}", found, "the file needs a variable 'pose'")
        reference = planar_rows(np.asarray(variables["pose"]), len(names), f"{path}/{source}")
    return ScanSequence(Path(path).stem, points, mask, unit or "px", reference)


def _list_files(path: Path) -> dict[str, bytes]:
    """Reads the PCD and MAT files by name; archives are read in memory and never unpacked."""
    if path.is_dir():
        chosen = [file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES]
        return {file.name: read_bytes(file) for file in chosen if file.is_file()}
    require(path.exists(), path, "no such file or folder", "check the path")
    # The parsers of tar, gzip, bzip2 and xz raise many kinds of errors.
    found, advice = "not a readable tar archive ({error})", "copy the archive again"
    with refusing(path, found, advice, (Exception,)), tarfile.open(path) as archive:
        members = [m for m in archive if m.isfile() and not m.issparse() and m.name.lower().endswith(_SUFFIXES)]
        members = [m for m in members if not PurePosixPath(m.name).name.startswith("._")]
        return {m.name: file.read() for m in members if (file := archive.extractfile(m)) is not None}

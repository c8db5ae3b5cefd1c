"""Several drives or agents at once: processes of a cluster map them, and their maps are merged two by two.

If a worker dies, Dask gives its tasks to another worker. This one continues from the saved state of the drive. Ray does
so, too, but needs a running service on each machine, and is ten times as large.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from dpmjax import saved_maps, slam, weights
from dpmjax.cli.drives import DriveOptions, ScanReader, open_drive
from dpmjax.cli.run import Numbers, Run, write_poses
from dpmjax.cli.slam_run import map_drive
from dpmjax.sequences import counted


class MappedAway(NamedTuple):
    """A drive that a worker has mapped.

    Attributes:
        T_world_scan: (n, 4, 4) poses of its scans.
        content: its map as an int8 file, which the worker sends.
        seconds: time of the worker.
    """

    T_world_scan: np.ndarray
    content: bytes
    seconds: float


def map_drives(
    client: Any,
    drives: Sequence[Path],
    options: DriveOptions,
    settings: slam.SlamConfig,
    run: Run,
    *,
    is_deskewed: bool,
) -> Numbers:
    """Maps drives, each on a worker, and merges their maps as a tree.

    Args:
        client: client of `distributed`.
        drives: folders that every worker sees.
        options: selection of their scans, and weights.
        settings: settings of SLAM.
        run: folder of the results, which every worker sees, too.
        is_deskewed: True undoes the motion of the lidar during its turn.

    Returns:
        Numbers of the run.
    """
    from distributed import as_completed

    began, num = time.perf_counter(), len(drives)
    folders = [run / f"drive_{number}" for number in range(1, num + 1)]
    places = zip(drives, folders, strict=True)
    begun = [client.submit(map_away, *place, options, settings, is_deskewed, pure=False) for place in places]
    for _ in tqdm(as_completed(begun), total=num, unit=" drives", dynamic_ncols=True):
        run.check_stop()
    mapped: list[MappedAway] = client.gather(begun)
    for folder, drive in zip(folders, mapped, strict=True):
        write_poses(folder, drive.T_world_scan, frame="T_world_lidar")
    level = [client.submit(list, [drive.content]) for drive in mapped]
    while len(level) > 1:
        pairs = [level[first : first + 2] for first in range(0, len(level), 2)]
        level = [client.submit(merge_away, *pair, options.weights) if len(pair) > 1 else pair[0] for pair in pairs]
    merged: list[bytes] = level[0].result()
    for part, content in enumerate(merged, start=1):
        (run / ("map.npz" if len(merged) == 1 else f"map_{part}.npz")).write_bytes(content)
    return {
        "verdict": f"{counted(num, 'drive')} in {counted(len(merged), 'map')}",
        "weights": options.weights,
        "num_drives": num,
        "num_maps": len(merged),
        "num_scans": sum(len(drive.T_world_scan) for drive in mapped),
        "sent_bytes": sum(len(drive.content) for drive in mapped),
        "map_bytes": sum(map(len, merged)),
        "drive_s": [drive.seconds for drive in mapped],
        "run_s": time.perf_counter() - began,
    }


def map_away(
    data: Path, folder: Path, options: DriveOptions, settings: slam.SlamConfig, is_deskewed: bool
) -> MappedAway:
    """Maps a drive in its folder, and continues from the state of an earlier worker if there is one."""
    began = time.perf_counter()
    methods = slam.make_methods(weights.load_model(options.weights), settings, weights=options.weights)
    reader = ScanReader(open_drive(data, options), is_deskewed=is_deskewed, jump=options.jump)
    _, result = map_drive(folder, reader, methods)
    return MappedAway(result.T_world_scan, saved_maps.map_bytes(result.map, "int8"), time.perf_counter() - began)


def merge_away(first: list[bytes], second: list[bytes], name: str) -> list[bytes]:
    """Merges two sets of maps; maps that show no common place stay apart."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, f"{number}.npz") for number in range(len(first) + len(second))]
        for path, content in zip(paths, [*first, *second], strict=True):
            path.write_bytes(content)
        merged = slam.merge_maps(slam.make_methods(weights.load_model(name), weights=name), *paths)
    return [saved_maps.map_bytes(slam_map, "int8") for slam_map in merged.maps]

"""Occupancy grids of planar scans as map.pgm and map.yaml, which Nav2 and other planners of ROS load."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.geometry import se2
from dpmjax.io.files import write_atomically


def write_grid_map(
    path: str | Path,
    poses: Float[np.ndarray, "n 3"],
    points: Float[np.ndarray, "n b 2"],
    mask: Bool[np.ndarray, "n b"],
    *,
    cell_m: float = 0.05,
) -> Path:
    """Writes the map of registered scans for planners.

    Args:
        path: name without ending; `.pgm` and `.yaml` are written.
        poses: T_world_scan as x, y, heading; metres, radians.
        points: end points of the beams in the frames of the scans, metres.
        mask: False for beams without an echo.
        cell_m: side of a cell; larger where the map would have more than 4,000 cells along a side.

    Returns:
        The path of the `.yaml`.
    """
    # More scans add no cell. Planners hold the map in memory, so larger places have larger cells.
    rows = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), 2000)).astype(int))
    ends = np.asarray(se2.transform_points(poses[rows], points[rows]), np.float64)
    hits = ends[mask[rows]]
    cell_m = max(cell_m, float(np.ptp(hits, axis=0).max()) / 4000)
    low = np.floor(hits.min(axis=0) / cell_m) - 2
    width, height = (np.floor(hits.max(axis=0) / cell_m) - low + 3).astype(int)
    passed, ended = np.zeros(width * height), np.zeros(width * height)
    for place, scan, is_echo in zip(poses[rows, :2], ends, mask[rows], strict=True):
        beams = scan[is_echo]
        # One sample a cell along the longest beam; a cell counts once for each beam that passes it.
        count = max(int(np.linalg.norm(beams - place, axis=1).max(initial=0.0) / cell_m), 1)
        way = place + np.arange(count)[:, None, None] / count * (beams - place)
        column, row = np.clip(np.floor(way / cell_m) - low, 0, [width - 1, height - 1]).astype(int).transpose(2, 0, 1)
        cells = row * width + column
        is_new = np.append(np.ones((1, len(beams)), bool), cells[1:] != cells[:-1], axis=0)
        np.add.at(passed, cells[is_new], 1)
        column, row = (np.floor(beams / cell_m) - low).astype(int).T
        np.add.at(ended, row * width + column, 1)
    share = ended / np.maximum(passed + ended, 1)
    # Beams that graze a wall pass its cells: a cell is occupied where more than 15 % of its beams end.
    # The map server reads 0 as occupied, 254 as free, 205 as unknown.
    values = np.where(share > 0.15, 0, np.where(passed + ended > 0, 254, 205))
    # The first row of the picture has the largest y.
    picture = values.reshape(height, width)[::-1].astype(np.uint8)
    path = Path(path)
    write_atomically(path.with_suffix(".pgm"), f"P5\n{width} {height}\n255\n".encode() + picture.tobytes())
    x, y = (low * cell_m).tolist()
    text = f"image: {path.with_suffix('.pgm').name}\nresolution: {cell_m:g}\norigin: [{x:.6g}, {y:.6g}, 0.0]\n"
    text += "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    return write_atomically(path.with_suffix(".yaml"), text)

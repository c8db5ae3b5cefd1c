"""Submaps as scans: several scans merged into one scan of a sensor with a full field of view.

A scan of a limited field of view shares few beams with the scan before where the robot turns or passes a door. Merged
scans on either side share more.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from dpmjax.geometry import se2
from dpmjax.registration2d.planar_scans import Floats, Indices, PlanarScans, planar_scans

# Number of beams of a submap, and largest number of its scans, spread evenly along the trajectory.
_NUM_BEAMS, _NUM_SCANS = 360, 12


def submap_scans(scans: PlanarScans, poses: Floats, centres: Indices, members: list[Indices]) -> PlanarScans:
    """Makes a scan of each submap from the nearest hit of all its scans at each bearing of the centre.

    Args:
        scans: n scans.
        poses: (n, 3) T_world_scan, correct within a submap.
        centres: (s,) rows of the scans whose frames are those of the submaps.
        members: rows of the scans of each submap, s arrays.

    Returns:
        s scans in no order, with the noise and the typical range of the scans.
    """
    points, mask = np.zeros((len(centres), _NUM_BEAMS, 2), np.float32), np.zeros((len(centres), _NUM_BEAMS), bool)
    hits, valid = np.asarray(scans.points, np.float64), np.asarray(scans.mask)
    for row, (centre, rows) in enumerate(zip(centres, members, strict=True)):
        used = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _NUM_SCANS)).round().astype(np.int64))]
        seen = se2.transform_points(se2.relative(poses[centre], poses[used]), hits[used])[valid[used]]
        bearing = np.arctan2(seen[:, 1], seen[:, 0]) % (2 * np.pi)
        beam = np.minimum((bearing * _NUM_BEAMS / (2 * np.pi)).astype(np.int64), _NUM_BEAMS - 1)
        order = np.lexsort((np.hypot(seen[:, 0], seen[:, 1]), beam))
        beams, first = np.unique(beam[order], return_index=True)
        points[row, beams], mask[row, beams] = seen[order[first]], True
    made = planar_scans(points, mask, is_ordered=False)
    ones = jnp.ones(len(centres))
    return made.replace(noises=scans.noise * ones, typical_ranges=scans.typical_range * ones)


def along_way(poses: Floats, rows: Indices, length: float) -> Indices:
    """Returns the first rows within this length of the trajectory from the first row."""
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[rows, :2], axis=0).T)))
    return rows[way <= length]

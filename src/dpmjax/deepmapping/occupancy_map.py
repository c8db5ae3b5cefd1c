"""The map that M-Net has learned, as a picture (DeepMapping figure 5, third column)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from dpmjax.deepmapping.planar import Fitted
from dpmjax.deepmapping.problem import bind_map
from dpmjax.geometry import se2

# Samples on a beam for what counts as explored.
_SAMPLES = 64


class MapPicture(NamedTuple):
    """A raster of the world; row 0 has the smallest y.

    Attributes:
        probability: (h, w) of being occupied.
        explored: (h, w) a beam has passed or ended there.
        extent: x_min, x_max, y_min, y_max in the unit of the points.
    """

    probability: NDArray[np.float32]
    explored: NDArray[np.bool_]
    extent: tuple[float, float, float, float]


def draw_map(
    fitted: Fitted, points: NDArray[np.floating], mask: NDArray[np.bool_], *, num_cells: int = 500
) -> MapPicture:
    """Evaluates M-Net wherever a beam has been.

    Args:
        fitted: the fit.
        points: (n, b, 2) its scans in the sensor frames, unit of the poses.
        mask: (n, b) False for beams that measured nothing.
        num_cells: along the longer side.

    Returns:
        MapPicture in the frame of `fitted.poses`.
    """
    poses = fitted.poses
    world = se2.transform_points(poses, points)
    hits = world[mask]
    low, high = hits.min(axis=0), hits.max(axis=0)
    margin = 0.03 * float((high - low).max())
    low, high = low - margin, high + margin
    cell = float((high - low).max()) / num_cells
    width, height = (np.ceil((high - low) / cell)).astype(int)
    explored = np.zeros((height, width), bool)
    sensors = np.broadcast_to(poses[:, None, :2], world.shape)[mask]
    for share in np.linspace(0.0, 1.0, _SAMPLES):
        column, row = ((sensors + share * (hits - sensors) - low) / cell).astype(int).T
        explored[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] = True
    x, y = low[0] + cell * (np.arange(width) + 0.5), low[1] + cell * (np.arange(height) + 0.5)
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / fitted.unit
    occupied = jax.jit(lambda params, points: jax.nn.sigmoid(bind_map(params, fitted.config)(points)))
    probability = np.asarray(occupied(fitted.params, centres.astype(np.float32))).reshape(height, width)
    extent = (float(low[0]), float(low[0] + cell * width), float(low[1]), float(low[1] + cell * height))
    return MapPicture(probability, _close_gaps(explored), extent)


def _close_gaps(explored: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Between two beams that pass on either side a cell counts as explored too."""
    from scipy.ndimage import binary_closing

    return binary_closing(explored, iterations=2) | explored

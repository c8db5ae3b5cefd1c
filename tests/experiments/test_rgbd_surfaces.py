"""What the surfaces in depth images leave open."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.sequences import ACTIVE_VISION, DepthSequence
from experiments._rgbd_methods import surface_spread

MOVES = np.array([0.0, 0.3, 0.6, 0.9])


def images(corner_m: float, turn: float) -> DepthSequence:
    """Four views along a wall at z = 2 m that meets another one at x = `corner_m`, the last one turned."""
    rows, columns = ACTIVE_VISION.sample_pixels(15, 24)
    rays = ACTIVE_VISION.rays(columns.astype(np.float64), rows.astype(np.float64))
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 0, 3] = MOVES
    T[3, :3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    world_rays = np.einsum("nij,hwj->nhwi", T[:, :3, :3], rays)
    ahead = 2.0 / world_rays[..., 2]
    beside = (corner_m - T[:, None, None, 0, 3]) / np.maximum(world_rays[..., 0], 1e-9)
    points = rays * np.minimum(ahead, np.where(beside > 0, beside, np.inf))[..., None]
    return DepthSequence("walls", points.astype(np.float32), np.ones(ahead.shape, bool), True, T)


@pytest.mark.parametrize(("corner_m", "low_mm", "high_mm"), [(1e3, 100.0, 400.0), (1.5, 0.0, 5.0)])
def test_one_wall_leaves_the_way_along_it_open_and_a_corner_does_not(corner_m, low_mm, high_mm) -> None:
    assert low_mm < surface_spread(images(corner_m, 0.2), 0.0015) < high_mm


def test_noise_and_spread_grow_together() -> None:
    seen = images(1.5, 0.2)
    assert surface_spread(seen, 0.006) > 1.5 * surface_spread(seen, 0.0015)

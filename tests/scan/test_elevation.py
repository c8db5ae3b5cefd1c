"""Laws of raised beams."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.scan import raise_beams

POINTS = np.random.default_rng(0).normal(size=(50, 3)) * [20, 20, 3]


def test_each_point_turns_about_the_axis_across_its_ray() -> None:
    across = np.cross(POINTS, [0.0, 0.0, 1.0])
    axes = across / np.linalg.norm(across, axis=1, keepdims=True)
    expected = Rotation.from_rotvec(np.radians(0.205) * axes).apply(POINTS)
    np.testing.assert_allclose(raise_beams(POINTS, 0.205), expected, atol=1e-5)


def test_azimuth_and_range_stay_and_back_is_back() -> None:
    raised = raise_beams(POINTS, 2.0)
    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(POINTS, axis=1), rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(*raised[:, :2].T), np.arctan2(*POINTS[:, :2].T), atol=1e-6)
    np.testing.assert_allclose(raise_beams(raised, -2.0), POINTS, atol=1e-4)


def test_points_straight_above_and_no_points_stay() -> None:
    above = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -2.0]])
    np.testing.assert_array_equal(raise_beams(above, 1.0), above)
    assert raise_beams(np.zeros((0, 3)), 1.0).shape == (0, 3)

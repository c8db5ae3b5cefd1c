"""Recorded scans with their poses."""

from __future__ import annotations

import numpy as np

from dpmjax.sequences import LidarSequence


def test_scans_in_the_frame_of_the_robot_begin_at_the_lidar() -> None:
    rng, T_base_lidar = np.random.default_rng(0), np.eye(4)
    T_base_lidar[:3] = [[0, -1, 0, 1.5], [1, 0, 0, 0.1], [0, 0, 1, 1.7]]
    in_lidar, T_world_base = rng.normal(size=(2, 50, 3)), np.tile(np.eye(4), (2, 1, 1))
    T_world_base[1, 0, 3] = 2.0
    in_base = in_lidar @ T_base_lidar[:3, :3].T + T_base_lidar[:3, 3]
    drive = LidarSequence("base", ("0", "1"), lambda row: in_base[row], T_world_base).from_base(T_base_lidar)
    np.testing.assert_allclose(drive[1], in_lidar[1], atol=1e-6)
    np.testing.assert_allclose(drive.T_world_lidar, T_world_base @ T_base_lidar)

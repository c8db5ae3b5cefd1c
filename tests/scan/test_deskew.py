"""Laws of deskewing: the scan of a moving lidar becomes the scan of the same lidar at rest."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se3
from dpmjax.scan import deskew, offsets_by_azimuth, offsets_by_times, scan_surface
from dpmjax.simulation import HDL64E, TownConfig, drive, make_town, scan_town


def motion(seed: int, turn: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


@pytest.mark.parametrize("turn", [0.0, 1e-7, 0.3, 1.5])
def test_points_come_back_to_where_they_stand_still(turn: float) -> None:
    rng = np.random.default_rng(3)
    T, still, offsets = motion(1, turn), rng.normal(size=(40, 3)) * 10, rng.uniform(-0.5, 0.5, 40)
    twist = np.asarray(se3.log(np.float32(T)), np.float64) if turn else np.r_[T[:3, 3], 0, 0, 0]
    omega = np.zeros((4, 4))
    omega[:3, :3] = np.cross(np.eye(3), twist[3:])
    omega[:3, 3] = twist[:3]
    measured = np.array(
        [rigid.inverse(expm(share * omega))[:3] @ [*p, 1] for p, share in zip(still, offsets, strict=True)]
    )
    np.testing.assert_allclose(deskew(measured, offsets, T), still, atol=1e-4)


def test_a_lidar_that_stands_still_changes_nothing() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(deskew(points, np.linspace(-0.5, 0.5, 20), np.eye(4)), points, rtol=1e-6)
    assert deskew(np.zeros((0, 3)), np.zeros(0), motion(0)).shape == (0, 3)


def test_a_turn_begins_and_ends_behind() -> None:
    angles = np.radians([179.9, 90, 0, -90, -179.9])
    points = 5 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    np.testing.assert_allclose(offsets_by_azimuth(points), [-0.5, -0.25, 0, 0.25, 0.5], atol=1e-3)
    np.testing.assert_allclose(
        offsets_by_azimuth(points, 0.2, is_clockwise=False), [0.1, 0.05, 0, -0.05, -0.1], atol=1e-3
    )


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("start", [0.0, 1.7e5])
def test_times_are_understood_in_any_unit_from_any_start(unit: float, start: float) -> None:
    times = unit * (start + np.array([0.0, 0.025, 0.05, 0.1]))
    np.testing.assert_allclose(offsets_by_times(times, 0.2), [-0.25, -0.125, 0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(offsets_by_times(times), [-0.5, -0.25, 0.0, 0.5], atol=1e-6)


@pytest.mark.parametrize("times", [[], [3.0, 3.0], [0.0, 7.0], [0.0, np.nan, 0.1], 500 * [1.7e9, 1.7e9 + 128]])
def test_what_are_no_times_of_a_turn_is_not_used(times: list[float]) -> None:
    assert offsets_by_times(np.array(times), 0.1) is None


@pytest.mark.slow
def test_a_scan_of_a_moving_lidar_equals_that_of_a_resting_one() -> None:
    town = make_town(3, TownConfig(route_length_m=300.0))
    pose = drive(town, seed=3).T_world_lidar[20]
    sensor = replace(
        HDL64E.with_azimuths(200), range_noise_m=0.0, drop_rate=0.0, beam_bias_m=0.0, mixed_rate=0.0, half_loss_m=1e6
    )
    twist = np.array([1.5, 0.1, 0.0, 0.0, 0.0, 0.15], np.float32)
    scans = []
    for moved in (np.zeros(6, np.float32), twist):
        cloud = scan_town(town.primitives, pose, 0.0, key=jax.random.key(0), sensor=sensor, motion=moved)
        scans.append(np.asarray(cloud.points)[np.asarray(cloud.mask)])
    still, moving = scans
    corrected = deskew(moving, offsets_by_azimuth(moving), np.asarray(rigid.exp(twist)))
    # The rays are others: surfaces are compared, along the normals of the scan at rest.
    surface = scan_surface(still)
    apart = []
    for points in (moving, corrected):
        rows, distances = (column[:, 0] for column in surface.tree.nearest(points, 1))
        is_near = (distances < 1.5) & (surface.flatness[rows] > 0.5)
        along = np.sum((points - surface.points[rows]) * surface.normals[rows], axis=1)[is_near]
        apart.append(float(np.quantile(np.abs(along), 0.8)))
    assert apart[0] > 0.05
    assert apart[1] < 0.3 * apart[0]


def test_wrong_shapes_are_told(as_user) -> None:
    with pytest.raises(ValueError, match="points: expected"):
        deskew(np.zeros((4, 3)), np.zeros(3), np.eye(4))
    with pytest.raises(ValueError, match="T_last_scan"):
        deskew(np.zeros((4, 3)), np.zeros(4), np.full((4, 4), np.nan))

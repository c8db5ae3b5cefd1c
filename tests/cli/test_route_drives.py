"""Drives along a trajectory of the user: the town follows it, and each scan is simulated once."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from dpmjax.cli.drives import STEP_M, DriveOptions, find_sources, keep_scans, open_drive, route_drive
from dpmjax.geometry import rigid
from dpmjax.io import InputError, LidarSequence, write_kitti, write_tum
from dpmjax.simulation.town import scan
from dpmjax.types import PointCloud

# Axes of a camera that looks ahead: x right, y down, z forward.
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def hill(num: int = 90, step_m: float = 1.0) -> np.ndarray:
    """A drive that bends to the left and climbs by 5 %."""
    T = np.tile(np.eye(4), (num, 1, 1))
    heading = np.linspace(0.0, 1.2, num)
    T[:, 0, 0] = T[:, 1, 1] = np.cos(heading)
    T[:, 1, 0], T[:, 0, 1] = np.sin(heading), -np.sin(heading)
    T[1:, :2, 3] = step_m * np.cumsum(T[:-1, :2, 0], axis=0)
    T[:, 2, 3] = 0.05 * step_m * np.arange(num)
    return T


@pytest.fixture
def without_rays(monkeypatch, tmp_path) -> Path:
    """Scans of one point, the position of the lidar; results go to the returned folder."""

    def scan_town(primitives, pose, time, **_) -> PointCloud:
        return PointCloud(jnp.asarray(pose[None, :3, 3], jnp.float32), jnp.ones(1, bool))

    monkeypatch.setattr(scan, "scan_town", scan_town)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_drive_follows_the_trajectory_and_its_heights(without_rays) -> None:
    truth = hill()
    drive = open_drive(write_tum(without_rays / "hill.tum", truth), DriveOptions())
    assert drive.name == "hill"
    assert "simulated along these poses" in drive.notes[0].text
    positions = drive.T_world_lidar[:, :3, 3]
    apart, nearest = KDTree(truth[:, :2, 3]).query(positions[:, :2])
    assert apart.max() < 1.2
    assert np.abs(positions[:, 2] - truth[nearest, 2, 3]).max() < 0.6
    spacing = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert spacing.max() < 1.1
    assert spacing.sum() == pytest.approx(89.0, rel=0.05)


def test_poses_of_a_camera_and_of_a_lidar_far_from_the_origin_make_the_same_drive(without_rays) -> None:
    truth = hill()
    camera = T_CAMERA_LIDAR @ truth @ rigid.inverse(T_CAMERA_LIDAR)
    far = truth.copy()
    far[:, :3, 3] += [400_000.0, 5_000_000.0, 80.0]
    drives = [
        route_drive(write(without_rays / f"{name}.txt", poses), seed=1)
        for name, write, poses in (
            ("lidar", write_tum, truth),
            ("camera", write_kitti, camera),
            ("far", write_tum, far),
        )
    ]
    for other in drives[1:]:
        np.testing.assert_allclose(other.T_world_lidar, drives[0].T_world_lidar, atol=1e-4)


def test_drives_to_train_and_to_evaluate_on_may_be_trajectories(without_rays) -> None:
    path = write_tum(without_rays / "hill.txt", hill())
    (source,) = find_sources([str(path)], [])
    np.testing.assert_array_equal(source().T_world_lidar, route_drive(path, seed=0).T_world_lidar)


@pytest.mark.parametrize("is_given", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_another_seed_makes_another_town(without_rays, is_given: bool) -> None:
    path = write_tum(without_rays / "hill.txt", hill()) if is_given else None
    first, again, other = (open_drive(path, DriveOptions(seed=seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.T_world_lidar, again.T_world_lidar)
    assert np.abs(first.T_world_lidar[:5] - other.T_world_lidar[:5]).max() > 1e-3


def test_a_scan_is_simulated_once_and_rounded(tmp_path) -> None:
    cast: list[int] = []
    points = np.random.default_rng(0).uniform(-90, 90, (50, 3)).astype(np.float32)

    def drive_of(shift_m: float) -> LidarSequence:
        def read_scan(index: int) -> np.ndarray:
            cast.append(index)
            return points + np.float32(index + shift_m) if index else np.zeros((0, 3), np.float32)

        return LidarSequence("made", ("a", "b", "c"), read_scan, np.tile(np.eye(4), (3, 1, 1)))

    first = keep_scans(drive_of(0.0), tmp_path)
    scans = [first.read_scan(index) for index in range(3)]
    assert scans[0].shape == (0, 3)
    assert np.abs(scans[1] - points - 1).max() <= 0.51 * STEP_M
    # The first and the last scan tell whether kept scans are those of the drive.
    cast.clear()
    for index, kept in enumerate(scans):
        np.testing.assert_array_equal(keep_scans(drive_of(0.0), tmp_path).read_scan(index), kept)
    assert 1 not in cast
    assert keep_scans(drive_of(0.5), tmp_path).read_scan(1)[0, 0] == pytest.approx(scans[1][0, 0] + 0.5, abs=STEP_M)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0\n1 0 0\n", "3 columns"),
        ("0 0 0 0 0 0 0 1\n1 3 0 0 0 0 0 1\n", "20 m"),
        ("no poses\n", "poses.txt"),
    ],
)
def test_a_file_that_is_no_drive_is_refused(without_rays, text: str, message: str) -> None:
    path = without_rays / "poses.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        open_drive(path, DriveOptions())
    assert not (without_rays / "results").exists()


@pytest.mark.slow
def test_nothing_stands_on_the_route(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = open_drive(write_tum(tmp_path / "hill.txt", hill()), DriveOptions())
    for index in range(0, len(drive), 12):
        points = drive.read_scan(index)
        assert len(points) > 30_000
        is_car = (np.abs(points[:, 0]) < 2.5) & (np.abs(points[:, 1]) < 1.0) & (np.abs(points[:, 2]) < 1.2)
        assert not is_car.any()


def test_scans_are_simulated_where_they_cannot_be_kept(tmp_path) -> None:
    points = np.ones((3, 3), np.float32)
    (tmp_path / "file").write_text("")
    kept = keep_scans(LidarSequence("town", ("a",), lambda _index: points), tmp_path / "file")
    np.testing.assert_array_equal(kept.read_scan(0), points)

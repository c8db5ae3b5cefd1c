"""Order and times of scans, and their reference poses: by time, by number, by order, or refused."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.io import InputError, open_lidar_sequence, write_kitti, write_tum
from dpmjax.io.references import to_seconds
from dpmjax.io.scan_names import sort_scans, stamps_in_names, strays_among
from tests.data_sets import write_pcd

NUM = 8
EPOCH = 1_600_000_000.0


def drive_along(times: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) on a gentle curve, 5 m/s."""
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(0.1 * times, [0, 0, 1])).as_matrix()
    T[:, 0, 3], T[:, 1, 3] = 50 * np.sin(0.1 * times), 50 * (1 - np.cos(0.1 * times))
    return T


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for index in range(NUM):
        write_pcd(tmp_path / f"{index:06d}.pcd", rng.uniform(-9, 9, (30, 3)))
    return tmp_path


def write_times(folder: Path, times: np.ndarray, *, unit: float = 1.0) -> None:
    (folder / "times.txt").write_text("".join(f"{time * unit:.9f}\n" for time in times))


def test_a_reference_of_another_rate_is_matched_by_time(folder: Path) -> None:
    times, fine = EPOCH + 0.1 * np.arange(NUM), EPOCH + 0.01 * np.arange(-3, 10 * NUM)
    write_times(folder, times)
    write_tum(folder / "groundtruth.txt", drive_along(fine - EPOCH), times=fine)
    drive = open_lidar_sequence(folder)
    np.testing.assert_allclose(drive.T_world_lidar, drive_along(times - EPOCH), atol=1e-4)
    (note,) = drive.notes
    assert "matched by time, tolerance 0.005 s; all scans have a reference pose" in note.text


@pytest.mark.parametrize("name", ["groundtruth.csv", "poses.csv"])
def test_references_with_commas_are_found(folder: Path, name: str) -> None:
    times = EPOCH + 0.1 * np.arange(NUM)
    write_times(folder, times)
    rows = write_tum(folder / name, drive_along(times - EPOCH), times=times).read_text()
    (folder / name).write_text(rows.replace(" ", ","))
    np.testing.assert_allclose(open_lidar_sequence(folder).T_world_lidar, drive_along(times - EPOCH), atol=1e-4)


def test_scans_between_poses_are_interpolated_and_those_beyond_are_counted(folder: Path) -> None:
    times, coarse = EPOCH + 0.1 * np.arange(NUM) + 0.04, EPOCH + 0.1 * np.arange(5)
    write_times(folder, times)
    write_tum(folder / "groundtruth.txt", drive_along(coarse - EPOCH), times=coarse)
    drive = open_lidar_sequence(folder)
    np.testing.assert_array_equal(drive.has_reference, [True] * 5 + [False] * 3)
    np.testing.assert_allclose(drive.T_world_lidar[:4], drive_along(times[:4] - EPOCH), atol=1e-3)
    assert drive.notes[0].is_doubt
    assert "3 of 8 scans have no reference pose" in drive.notes[0].text
    assert len(drive.take(np.flatnonzero(drive.has_reference))) == 5


def test_stamps_in_names_increase() -> None:
    left, right, later = Path("left_12.25.pcd"), Path("right_12.25.pcd"), Path("left_12.50.pcd")
    np.testing.assert_array_equal(stamps_in_names([left, later]), [12.25, 12.5])
    # Two lidars at one time, and a wrong order.
    for files in ([left, right], [left, right, later], [later, left]):
        assert stamps_in_names(files) is None


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("start", [0.0, EPOCH])
def test_stamps_in_smaller_units_become_seconds(folder: Path, unit: float, start: float) -> None:
    times, fine = start + 0.1 * np.arange(NUM), start + 0.02 * np.arange(5 * NUM)
    write_times(folder, times, unit=unit)
    write_tum(folder / "groundtruth.txt", drive_along(fine - start), times=fine * unit)
    drive = open_lidar_sequence(folder)
    np.testing.assert_allclose(drive.times, times, atol=1e-6)
    np.testing.assert_allclose(drive.T_world_lidar, drive_along(times - start), atol=1e-3)


@pytest.mark.parametrize("stamps", [np.arange(9.0), 0.05 * np.arange(9), EPOCH + np.arange(9.0), np.zeros(1)])
def test_seconds_stay_seconds(stamps: np.ndarray) -> None:
    np.testing.assert_array_equal(to_seconds(stamps), stamps)


def test_names_that_are_stamps_are_times(tmp_path: Path) -> None:
    times = EPOCH + 0.1 * np.arange(NUM)
    for time in times:
        write_pcd(tmp_path / f"lidar_{round(time * 1e9)}.pcd", np.random.default_rng(0).uniform(-9, 9, (30, 3)))
    fine = EPOCH + 0.02 * np.arange(5 * NUM)
    write_tum(tmp_path / "groundtruth.txt", drive_along(fine - EPOCH), times=fine)
    drive = open_lidar_sequence(tmp_path)
    np.testing.assert_allclose(drive.times, times, atol=1e-6)
    np.testing.assert_allclose(drive.T_world_lidar, drive_along(times - EPOCH), atol=1e-3)


@pytest.mark.parametrize("form", ["{0}_{1:09}", "left-{0}-{1:09}", "{0}.{1:09}"])
def test_names_of_seconds_and_nanoseconds_are_times(form: str) -> None:
    stamps_ns = np.arange(23) * 100_000_000 + 12_345_678
    files = [Path(f"{form.format(1_600_000_000 + ns // 10**9, ns % 10**9)}.pcd") for ns in stamps_ns.tolist()]
    assert sort_scans(files[::-1]) == files
    np.testing.assert_allclose(stamps_in_names(files), EPOCH + 1e-9 * stamps_ns, atol=1e-6)


@pytest.mark.parametrize("rows", [[2, 1], [1, 1]])
def test_times_that_do_not_increase_are_doubted(folder: Path, rows: list[int]) -> None:
    times = EPOCH + 0.1 * np.arange(NUM)
    write_times(folder, times)
    assert open_lidar_sequence(folder).notes == ()
    times[1:3] = times[rows]
    write_times(folder, times)
    (note,) = open_lidar_sequence(folder).notes
    assert f"1 of {NUM} times are not later than the one before, the first is that of scan 2" in note.text


@pytest.mark.parametrize("first", [0, 1])
def test_numbers_of_rows_are_no_times(folder: Path, first: int) -> None:
    times = EPOCH + 0.1 * np.arange(NUM)
    (folder / "times.txt").write_text("".join(f"{first + row} {time:.6f}\n" for row, time in enumerate(times)))
    np.testing.assert_allclose(open_lidar_sequence(folder).times, times, atol=1e-6)
    write_times(folder, np.arange(float(NUM)))  # once a second
    np.testing.assert_array_equal(open_lidar_sequence(folder).times, np.arange(float(NUM)))


def test_stamps_may_be_the_numbers_of_scans(folder: Path) -> None:
    poses = drive_along(0.1 * np.arange(NUM))
    write_times(folder, 0.1 * np.arange(NUM))
    write_tum(folder / "groundtruth.txt", poses[[0, 2, 3, 7]], times=[0, 2, 3, 7])
    drive = open_lidar_sequence(folder)
    np.testing.assert_array_equal(np.flatnonzero(drive.has_reference), [0, 2, 3, 7])
    np.testing.assert_allclose(drive.T_world_lidar[[0, 2, 3, 7]], poses[[0, 2, 3, 7]], atol=1e-8)


def test_poses_of_other_counts_without_times_are_refused(folder: Path) -> None:
    write_tum(folder / "groundtruth.txt", drive_along(np.arange(30.0)), times=EPOCH + 0.01 * np.arange(30))
    with pytest.raises(InputError, match="30 poses for 8 scans, and the scans have no times"):
        open_lidar_sequence(folder)
    (folder / "groundtruth.txt").unlink()
    write_kitti(folder / "poses.txt", drive_along(np.arange(30.0)))
    with pytest.raises(InputError, match="30 poses for 8 scans, and the file has no times"):
        open_lidar_sequence(folder)


def test_times_that_never_meet_are_matched_by_count_or_refused(folder: Path) -> None:
    write_times(folder, 0.1 * np.arange(NUM))
    poses = drive_along(0.1 * np.arange(NUM))
    write_tum(folder / "groundtruth.txt", poses, times=EPOCH + 0.1 * np.arange(NUM))
    drive = open_lidar_sequence(folder)
    np.testing.assert_allclose(drive.T_world_lidar, poses, atol=1e-8)
    assert "no scan has the time of a pose; poses are matched by their order" in drive.notes[0].text
    write_tum(folder / "groundtruth.txt", poses[:5], times=EPOCH + 0.1 * np.arange(5))
    with pytest.raises(InputError, match="5 poses for 8 scans, and no scan has the time of a pose"):
        open_lidar_sequence(folder)


T_CAM_LIDAR = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]])


def test_poses_of_a_camera_are_named_and_with_a_calibration_converted(folder: Path) -> None:
    T = drive_along(np.arange(float(NUM)))
    write_kitti(folder / "poses.txt", T_CAM_LIDAR @ T @ np.linalg.inv(T_CAM_LIDAR))
    (note,) = open_lidar_sequence(folder).notes
    assert note.is_doubt
    assert "poses move along their own z axis" in note.text
    numbers = " ".join(f"{value:.9g}" for value in T_CAM_LIDAR[:3].ravel())
    (folder / "calib.txt").write_text(f"P0: 1 0 0\nTr: {numbers}\n")
    drive = open_lidar_sequence(folder)
    assert drive.notes == ()
    np.testing.assert_allclose(drive.T_world_lidar, T, atol=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["0.0", "0.05", "0.1", "0.15", "0.2"],
        ["scan_9.5", "scan_10.25", "scan_100"],
        ["1.8", "1.9", "1.10", "1.11"],
        ["1600000000.900000", "1600000001.000000"],
        [".0", ".05", ".1", ".15"],
        ["2", "10", "11"],
        # Decimals whose last zeros are left out.
        ["1600000000.15", "1600000000.2", "1600000000.25", "1600000000.3"],
    ],
)
def test_names_are_sorted_as_numbers(names: list[str]) -> None:
    files = [Path(f"{name}.bin") for name in names]
    assert sort_scans([*reversed(files)]) == files


def test_a_stray_map_is_named_and_left_out(folder: Path) -> None:
    write_pcd(folder / "map.pcd", np.random.default_rng(0).uniform(-90, 90, (300, 3)))
    drive = open_lidar_sequence(folder)
    assert len(drive) == NUM
    assert "map.pcd is no scan" in drive.notes[0].text
    assert strays_among([Path("a.pcd"), Path("b.pcd"), Path("c1.pcd")]) == []


@pytest.mark.parametrize("suffix", [".npy", ".bin", ".npz"])
@pytest.mark.parametrize("num", [2, NUM])
def test_labels_beside_scans_are_left_out_and_named(folder: Path, suffix: str, num: int) -> None:
    for index in range(num):
        (folder / f"{index:06d}{suffix}").write_bytes(bytes(30))
    drive = open_lidar_sequence(folder)
    assert {Path(source).suffix for source in drive.sources} == {".pcd"}
    assert f"{num} {suffix} left out beside {NUM} .pcd" in drive.notes[0].text

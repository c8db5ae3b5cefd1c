"""The number of columns of raw files: inferred from the values, by the ending, or said."""

import logging
from pathlib import Path

import numpy as np
import pytest

from dpmjax.io import InputError, open_lidar_sequence, read_lidar_file, require_whole_files, scan_notes
from dpmjax.io.lidar_file import find_columns

NUM = 1200


@pytest.fixture
def table() -> np.ndarray:
    rng = np.random.default_rng(0)
    azimuth, ring = rng.uniform(-np.pi, np.pi, NUM), rng.integers(0, 32, NUM)
    ranges = rng.uniform(3, 40, NUM)
    height = ranges * np.tan(np.radians(ring - 25.0))
    xyz = [ranges * np.cos(azimuth), ranges * np.sin(azimuth), height]
    more = [
        rng.integers(0, 255, NUM),
        ring,
        np.linspace(0, 0.1, NUM),
        rng.normal(900, 90, NUM),
        rng.integers(0, 9, NUM),
    ]
    return np.stack([*xyz, *more], axis=1).astype("<f4")


@pytest.mark.parametrize("columns", [3, 4, 5, 6, 7, 8])
def test_columns_are_judged_by_the_values(tmp_path: Path, table: np.ndarray, columns: int) -> None:
    path = tmp_path / "0.bin"
    table[:, :columns].tofile(path)  # 1200 points of any number of columns fit all of 3, 4, 5, 6 and 8
    found, note = find_columns(path, path.read_bytes())
    assert found == columns
    assert (note is None) == (columns == 4)
    np.testing.assert_array_equal(read_lidar_file(path), table[:, :3])


def test_a_cut_file_is_not_taken_for_one_of_other_columns(tmp_path: Path, table: np.ndarray) -> None:
    for num_bytes in (4, 12):  # 4799 numbers, and 4797, which are 3 x 1599
        (tmp_path / "0.bin").write_bytes(table[:, :4].tobytes()[:-num_bytes])
        with pytest.raises(InputError, match="no whole number of points of 4 float32"):
            read_lidar_file(tmp_path / "0.bin")


@pytest.mark.parametrize("columns", [3, 4, 5])
@pytest.mark.parametrize("digits", [2, 9])
@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_float64_is_named(tmp_path: Path, table: np.ndarray, columns: int, digits: int, scale: float) -> None:
    path = tmp_path / "0.bin"
    points = np.round(table[:, :columns] * scale, digits)
    points.astype("<f8").tofile(path)
    with pytest.raises(InputError, match=r"0\.bin: the values are float64; save them as float32"):
        read_lidar_file(path)
    with pytest.raises(InputError, match="the values are float64"):
        open_lidar_sequence(tmp_path)
    points[np.random.default_rng(0).permutation(NUM)[: NUM // 2]] = 0  # beams without a hit
    points.tofile(path)
    assert len(read_lidar_file(path)) == NUM // 2


def test_values_that_do_not_tell_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    np.random.default_rng(0).normal(0, 10, (NUM, 4)).astype("<f4").tofile(tmp_path / "0.bin")
    with caplog.at_level(logging.WARNING):
        read_lidar_file(tmp_path / "0.bin")
    assert "4 columns a point are assumed, 3 or 5 or 6 or 8 would fit as well; --columns decides" in caplog.text
    caplog.clear()
    assert len(read_lidar_file(tmp_path / "0.bin", bin_columns=3)) == NUM // 3 * 4
    assert not caplog.records


@pytest.mark.parametrize("given", [3, 7])
def test_given_columns_that_the_values_contradict_are_a_doubt(tmp_path: Path, table: np.ndarray, given: int) -> None:
    table[: 7 * (NUM // 7), :4].tofile(tmp_path / "0.bin")
    doubt = f"0.bin: --columns {given}, but the values look like 4 columns a point"
    (note,) = open_lidar_sequence(tmp_path, bin_columns=given).notes
    assert note.is_doubt
    assert note.text.endswith(doubt)
    points = read_lidar_file(tmp_path / "0.bin", bin_columns=given)
    (note,) = scan_notes(tmp_path / "0.bin", points, bin_columns=given)
    assert note.is_doubt
    assert note.text.endswith(doubt)
    assert not open_lidar_sequence(tmp_path, bin_columns=4).notes


def test_the_ending_of_nuscenes_tells_where_values_do_not(tmp_path: Path) -> None:
    path = tmp_path / "n015__LIDAR_TOP__1532402927647951.pcd.bin"
    np.random.default_rng(0).normal(0, 10, (NUM, 5)).astype("<f4").tofile(path)
    assert find_columns(path, path.read_bytes())[0] == 5


def test_one_scan_decides_for_its_drive(tmp_path: Path, table: np.ndarray) -> None:
    for index in range(3):
        table[index:, :5].tofile(tmp_path / f"{index}.bin")
    drive = open_lidar_sequence(tmp_path)
    (note,) = drive.notes
    assert note.text.endswith("5 columns a point, inferred from the values; --columns decides")
    for index in range(3):
        np.testing.assert_array_equal(drive.read_scan(index), table[index:, :3])
    require_whole_files(drive)
    (tmp_path / "2.bin").write_bytes(table[:, :5].tobytes()[:-8])
    with pytest.raises(InputError, match=r"2\.bin.*of 5 float32"):
        require_whole_files(drive)


def test_points_of_nclt_are_metres_with_z_up(tmp_path: Path, table: np.ndarray, caplog) -> None:
    record = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
    rows = np.zeros(NUM, record)
    rows["xyz"] = np.round((table[:, :3] * [1, -1, -1] + 100.0) / 0.005)
    rows["intensity"], rows["laser"] = table[:, 3], table[:, 4]
    for name in ("0.bin", "1.bin"):
        rows.tofile(tmp_path / name)
    caplog.set_level(logging.INFO, logger="dpmjax")
    np.testing.assert_allclose(read_lidar_file(tmp_path / "0.bin"), table[:, :3], atol=0.003)
    assert "as of NCLT" in caplog.text
    drive = open_lidar_sequence(tmp_path)
    np.testing.assert_allclose(drive.read_points(1), table[:, :3], atol=0.003)
    require_whole_files(drive)
    (tmp_path / "1.bin").write_bytes(rows.tobytes()[:-3])
    with pytest.raises(InputError, match="no whole number of points"):
        read_lidar_file(tmp_path / "1.bin")

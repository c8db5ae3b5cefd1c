"""LAS and LAZ scans, written by laspy."""

import io
from pathlib import Path

import numpy as np
import pytest

from dpmjax.io import InputError, open_lidar_sequence, read_lidar_file
from dpmjax.io.lidar_file import read_point_times
from tests.optional import import_or_skip


def write_las(path: Path, points: np.ndarray, *, times: np.ndarray | None = None, version: str = "1.2") -> Path:
    """Millimetres, with or without GPS times; the ending decides on compression."""
    laspy = import_or_skip("laspy")
    if path.suffix == ".laz":
        import_or_skip("lazrs")
    new = {"1.2": (0, 1), "1.4": (6, 6)}[version][times is not None]
    header = laspy.LasHeader(point_format=new, version=version)
    header.scales, header.offsets = np.full(3, 1e-3), np.floor(points.min(axis=0))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    if times is not None:
        cloud.gps_time = times
    with io.BytesIO() as stream:
        cloud.write(stream, do_compress=path.suffix == ".laz")
        path.write_bytes(stream.getvalue())
    return path


@pytest.fixture
def points() -> np.ndarray:
    return np.round(np.random.default_rng(0).uniform(-30, 30, (200, 3)), 3)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_points_and_times_are_read(tmp_path: Path, points: np.ndarray, suffix: str, version: str) -> None:
    times = 3e8 + np.linspace(0, 0.1, len(points))
    path = write_las(tmp_path / f"0{suffix}", points, times=times, version=version)
    np.testing.assert_allclose(read_lidar_file(path), points, atol=1e-5)
    np.testing.assert_allclose(read_point_times(path), times)
    assert len(open_lidar_sequence(tmp_path)) == 1


def test_national_coordinates_get_an_origin(tmp_path: Path, points: np.ndarray) -> None:
    path = write_las(tmp_path / "0.laz", points + np.array([512_000.0, 5_403_000.0, 300.0]))
    with pytest.raises(InputError, match=r"UTM; subtract an origin such as 51\d{4} 540\d{4} \d{3}"):
        read_lidar_file(path)


@pytest.mark.parametrize("damage", ["cut", "header", "count", "empty"])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_damaged_files_are_named(tmp_path: Path, points: np.ndarray, suffix: str, damage: str) -> None:
    path = write_las(tmp_path / f"0{suffix}", points)
    content = bytearray(path.read_bytes())
    if damage == "cut":
        content = content[: len(content) - 600]
    elif damage == "header":
        content[0:4] = b"XXXX"
    elif damage == "count":
        content[107:111] = np.array([2**32 - 1], "<u4").tobytes()
    else:
        content = bytearray()
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"0\{suffix}: "):
        read_lidar_file(path)

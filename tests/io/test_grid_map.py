"""Laws of grid maps in the world's frame: walls are occupied, cells on beams free, all further cells unknown."""

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import write_grid_map


def read(path) -> tuple[np.ndarray, dict[str, str]]:
    head, size, depth, data = (path.with_suffix(".pgm")).read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    assert (head, depth) == (b"P5", b"255")
    settings = dict(line.split(": ", 1) for line in path.with_suffix(".yaml").read_text().splitlines())
    return np.frombuffer(data, np.uint8).reshape(height, width)[::-1], settings


def room_scans(poses: np.ndarray, half_x: float, half_y: float) -> np.ndarray:
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False) + 0.001
    scans = []
    for x, y, heading in poses:
        way = np.stack([np.cos(angles + heading), np.sin(angles + heading)], axis=1)
        walls = np.where(way > 0, [half_x, half_y], [-half_x, -half_y]) - [x, y]
        reach = (walls / way).min(axis=1)
        scans.append(reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    return np.array(scans)


@pytest.mark.parametrize("cell_m", [0.05, 0.1])
def test_a_room_is_free_within_its_walls(tmp_path, cell_m: float) -> None:
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.7], [-1.2, -0.3, 2.0]])
    points = room_scans(poses, 3.025, 2.025)
    mask = np.ones(points.shape[:2], bool)
    shift = np.array([10.0, -4.0, 0.5])
    write_grid_map(tmp_path / "map", se2.compose(shift, poses), points, mask, cell_m=cell_m)
    picture, settings = read(tmp_path / "map")
    assert settings["image"] == "map.pgm"
    assert float(settings["resolution"]) == cell_m
    origin = np.array([float(x) for x in settings["origin"].strip("[]").split(",")[:2]])

    def at(place: list[float]) -> int:
        world = se2.transform_points(shift, np.array([place]))[0]
        column, row = np.floor((world - origin) / cell_m).astype(int)
        return int(picture[row, column])

    assert at([0.0, 0.0]) == at([2.5, 1.5]) == 254
    assert picture[0, 0] == 205
    # Walls have no gaps: each beam of a finer scan meets an occupied cell near its end.
    ends = se2.transform_points(shift, room_scans(np.zeros((1, 3)), 3.025, 2.025)[0])
    columns, rows = np.floor((ends - origin) / cell_m).astype(int).T
    near = np.stack([picture[rows + i, columns + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    assert (near == 0).any(axis=0).all()


def test_beams_without_an_echo_do_not_matter(tmp_path) -> None:
    poses, points = np.zeros((2, 3)), room_scans(np.zeros((2, 3)), 3.0, 2.0)
    mask = np.ones(points.shape[:2], bool)
    mask[:, ::3] = False
    write_grid_map(tmp_path / "a", poses, points, mask)
    points[~mask] = 1e3
    write_grid_map(tmp_path / "b", poses, points, mask)
    np.testing.assert_array_equal(read(tmp_path / "a")[0], read(tmp_path / "b")[0])


def test_a_wide_map_has_larger_cells(tmp_path) -> None:
    points = np.array([[[3000.0, 1.0], [-3000.0, 2.0], [10.0, -5.0]]])
    write_grid_map(tmp_path / "map", np.zeros((1, 3)), points, np.ones((1, 3), bool))
    picture, settings = read(tmp_path / "map")
    assert max(picture.shape) <= 4010
    assert float(settings["resolution"]) == pytest.approx(1.5)

"""PLY files in and out."""

import numpy as np
import pytest

from dpmjax.io import InputError, write_ply
from tests.data_sets import read_ply
from tests.optional import import_or_skip

POINTS = np.array([[1, 2, 3], [-4, 5.5, 6], [0.25, 0, -1]], np.float32)
HEADER = """ply
format {} 1.0
comment made by hand
element vertex 3
property uchar tag
property double y
property float x
property float32 z
element face 1
property list uchar int vertex_indices
end_header
"""
LAYOUT = [("tag", "u1"), ("y", "f8"), ("x", "f4"), ("z", "f4")]


def table(order):
    rows = np.zeros(3, [(name, order + kind) for name, kind in LAYOUT])
    rows["x"], rows["y"], rows["z"] = POINTS.T
    return rows


@pytest.mark.parametrize(("encoding", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_properties_come_in_any_order_and_type(tmp_path, encoding, order):
    (tmp_path / "a.ply").write_bytes(HEADER.format(encoding).encode() + table(order).tobytes() + b"\3\0\0\0\0")
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply"), POINTS)


def test_ascii_is_read(tmp_path):
    rows = "".join(f"7 {y} {x} {z}\n" for x, y, z in POINTS)
    (tmp_path / "a.ply").write_text(HEADER.format("ascii") + rows + "3 0 1 2\n")
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply"), POINTS)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "no PLY header"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\n", "no PLY header"),
        (HEADER.format("binary_little_endian").encode() + b"123", "truncated"),
        (HEADER.format("ascii").encode() + b"1 2 3 4\n", "truncated"),
        (HEADER.format("ascii").encode() + b"1 2 3 4\n1 2\n3 4 5 6\n", "row 2 is not 4 numbers"),
        (HEADER.format("morse").encode(), "unknown|morse"),
        (HEADER.format("ascii").replace("float32 z", "float32 w").encode(), "PLY properties"),
        (HEADER.format("ascii").replace("double", "quadruple").encode(), "broken PLY header"),
    ],
)
def test_broken_files_are_named(tmp_path, content, found):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(InputError, match=f"bad.ply.*({found})"):
        read_ply(tmp_path / "bad.ply")


def test_colours_are_written_and_the_points_stay(tmp_path):
    colors = np.array([[1, 2, 3], [255, 0, 9], [7, 7, 7]], np.uint8)
    path = write_ply(tmp_path / "a.ply", POINTS, colors=colors)
    np.testing.assert_array_equal(read_ply(path), POINTS)
    plyfile = import_or_skip("plyfile")
    vertices = plyfile.PlyData.read(str(path))["vertex"]
    np.testing.assert_array_equal(np.column_stack([vertices[name] for name in ("red", "green", "blue")]), colors)
    np.testing.assert_array_equal(read_ply(write_ply(tmp_path / "a.ply", POINTS)), POINTS)
    with pytest.raises(ValueError, match="colors must be"):
        write_ply(tmp_path / "a.ply", POINTS, colors=colors[:2])
    with pytest.raises(ValueError, match="points"):
        write_ply(tmp_path / "a.ply", POINTS[:, :2])

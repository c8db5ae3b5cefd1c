"""g2o files: the order of the numbers, exact round trips, refusals in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax import Edges, PoseGraph, optimize_pose_graph, read_g2o, write_g2o
from dpmjax.io import InputError
from tests.optional import import_or_skip

PLANAR = """# two nodes and a loop
VERTEX_SE2 7 0 0 0
VERTEX_SE2 3 1 2 0.5

FIX 3
EDGE_SE2 7 3 1.1 2.1 0.4 11 12 13 22 23 99
"""
SPATIAL = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 2 3 0 0 0.6 0.8
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 2 3 0 0.6 0 0.8 """


def written(folder: Path, text: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text(text)
    return path


def assert_same(graph: PoseGraph, other: PoseGraph) -> None:
    for name in ("poses", "ids", "is_fixed"):
        np.testing.assert_allclose(getattr(graph, name), getattr(other, name), rtol=0, atol=1e-15)
    for one, two in zip(graph.edges, other.edges, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-15)


def spatial_text(seed: int = 0) -> tuple[str, np.ndarray]:
    roots = np.random.default_rng(seed).normal(size=(6, 6))
    information = roots @ roots.T
    return SPATIAL + " ".join(f"{x:.17g}" for x in information[np.triu_indices(6)]) + "\n", information


def test_planar_numbers_stand_where_the_format_says(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, PLANAR))
    np.testing.assert_array_equal(graph.ids, [7, 3])
    np.testing.assert_array_equal(graph.is_fixed, [False, True])
    np.testing.assert_array_equal(graph.poses, [[0, 0, 0], [1, 2, 0.5]])
    assert (graph.edges.target[0], graph.edges.source[0]) == (0, 1)
    np.testing.assert_array_equal(graph.edges.measurements, [[1.1, 2.1, 0.4]])
    np.testing.assert_array_equal(graph.edges.information, [[[11, 12, 13], [12, 22, 23], [13, 23, 99]]])


def test_spatial_numbers_stand_where_the_format_says(tmp_path: Path) -> None:
    text, information = spatial_text()
    graph = read_g2o(written(tmp_path, text))
    angle = 2 * np.arctan2(0.6, 0.8)
    np.testing.assert_allclose(graph.poses[1, :3, :3], Rotation.from_euler("z", angle).as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(graph.poses[1, :, 3], [1, 2, 3, 1])
    measured = graph.edges.measurements[0]
    np.testing.assert_allclose(measured[:3, :3], Rotation.from_euler("y", angle).as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(graph.edges.information[0], information)


@pytest.mark.parametrize("text", [PLANAR, spatial_text()[0]], ids=["plane", "space"])
def test_graph_is_read_as_it_was_written(tmp_path: Path, text: str) -> None:
    graph = read_g2o(written(tmp_path, text))
    assert_same(read_g2o(write_g2o(tmp_path / "new" / "again.g2o", graph)), graph)


@pytest.mark.parametrize("text", [PLANAR.replace("FIX 3\n", ""), spatial_text()[0]], ids=["plane", "space"])
def test_gtsam_reads_the_same_cost(tmp_path: Path, text: str) -> None:
    gtsam = import_or_skip("gtsam")
    graph = read_g2o(written(tmp_path, text))
    path = write_g2o(tmp_path / "ours.g2o", graph)
    factors, values = gtsam.readG2o(str(path), graph.tangent_size == 6)
    np.testing.assert_allclose(2 * factors.error(values), optimize_pose_graph(graph).chi2_initial, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no vertices"),
        ("VERTEX_XY 0 1 2", "line 1: 'VERTEX_XY' is not read here"),
        (PLANAR + "VERTEX_SE3:QUAT 9 0 0 0 0 0 0 1\n", "is not read here"),
        (PLANAR + "EDGE_SE2 7 3 1 2\n", "line 7: 4 values after EDGE_SE2"),
        (PLANAR + "VERTEX_SE2 8 0 zero 0\n", "line 7: not a number"),
        (PLANAR + "VERTEX_SE2 x 0 0 0\n", "line 7: not a number"),
        (PLANAR + "VERTEX_SE2 8 0 nan 0\n", "expected finite numbers"),
        (PLANAR + "VERTEX_SE2 7 0 0 0\n", "every id once"),
        (PLANAR + "FIX 12\n", "node 12 has no vertex"),
        (PLANAR + "FIX one\n", "one"),
        (PLANAR + "EDGE_SE2 7 5 1 2 3 1 0 0 1 0 1\n", "node 5 has no vertex"),
        (PLANAR + "EDGE_SE2 7 7 1 2 3 1 0 0 1 0 1\n", "another node"),
        (PLANAR + "EDGE_SE2 7 3 1 2 3 1 0 0 -1 0 1\n", "positive semidefinite"),
        (spatial_text()[0].replace("0.6 0.8", "0 0"), "quaternion"),
        ("VERTEX_SE2 99999999999999999999 0 0 0", "graph.g2o"),
    ],
)
def test_bad_file_is_refused_in_one_line(tmp_path: Path, text: str, message: str, as_user) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError, match="graph.g2o") as refused:
        read_g2o(path)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_missing_file_and_bytes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_g2o(tmp_path / "none.g2o")
    path = tmp_path / "bytes.g2o"
    path.write_bytes(np.random.default_rng(0).bytes(500))
    with pytest.raises(InputError):
        read_g2o(path)


def test_a_graph_of_one_pose_is_written_and_read(tmp_path: Path) -> None:
    nothing = Edges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
    path = write_g2o(tmp_path / "one.g2o", PoseGraph.create(np.eye(4)[None], nothing, ids=[7]))
    found = read_g2o(path)
    np.testing.assert_array_equal(found.ids, [7])
    assert len(found.edges.source) == 0

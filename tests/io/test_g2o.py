"""g2o files: the order of the numbers, exact round trips, refusals in one line."""

import gzip
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
    again = write_g2o(tmp_path / "new" / "again.g2o", graph)
    assert_same(read_g2o(again), graph)
    packed = tmp_path / "again.g2o.gz"
    packed.write_bytes(gzip.compress(again.read_bytes()))
    assert_same(read_g2o(packed), graph)


def test_gtsam_reads_the_same_cost_in_space(tmp_path: Path) -> None:
    gtsam = import_or_skip("gtsam")
    graph = read_g2o(written(tmp_path, spatial_text()[0]))
    path = write_g2o(tmp_path / "ours.g2o", graph)
    factors, values = gtsam.readG2o(str(path), True)
    np.testing.assert_allclose(2 * factors.error(values), optimize_pose_graph(graph).chi2_initial, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no vertices"),
        (PLANAR + "VERTEX_SE3:QUAT 9 0 0 0 0 0 0 1\n", "line 7: 'VERTEX_SE3:QUAT' is not read here"),
        (PLANAR + "VERTEX_XY 2 1 1\n", "landmarks are not read"),
        (PLANAR + "EDGE_SE2_MAXMIX 7 3 0.1 1 0 0 1 0 0 1 0 1\n", "switchable and mixture edges are not read"),
        (PLANAR + "EDGE_PRIOR_SE2 7 1 0 0 1 0 0 1 0 1\n", "priors of single poses are not read"),
        (PLANAR + "EDGE3 7 3 1\n", "in the plane, or one in space"),
        (PLANAR + "EDGE_SE2 7 3 1 2\n", "line 7: 4 values after EDGE_SE2"),
        (PLANAR + "VERTEX_SE2 8 0 zero 0\n", "line 7: could not convert string to float: 'zero'"),
        (PLANAR + "VERTEX_SE2 x 0 0 0\n", "line 7: invalid literal for int() with base 10: 'x'"),
        (PLANAR + "VERTEX_SE2 8 0 nan 0\n", "expected finite numbers"),
        (PLANAR + "VERTEX_SE2 7 0 0 0\n", "line 7: node 7 has a vertex in an earlier line, too"),
        (PLANAR + "FIX 12\n", "line 7: node 12 has no vertex"),
        (PLANAR + "FIX one\n", "line 7: invalid literal for int() with base 10: 'one'"),
        (PLANAR + "EDGE_SE2 7 5 1 2 3 1 0 0 1 0 1\n", "node 5 has no vertex"),
        (PLANAR + "EDGE_SE2 7 7 1 2 3 1 0 0 1 0 1\n", "line 7: an edge from node 7 to itself"),
        (PLANAR + "EDGE_SE2 7 3 1e200 2 3 1 0 0 1 0 1\n", "line 7: expected finite numbers below 1e+75, got 1e+200"),
        (PLANAR + "EDGE_SE2 7 3 1 2 3 1e200 0 0 1 0 1\n", "line 7: the information of edge 7 3 is not finite, or huge"),
        (SPATIAL, "line 4: 9 values after EDGE_SE3:QUAT, the information matrix is missing"),
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
    with pytest.raises(InputError, match="no such file"):
        read_g2o(tmp_path / "none.g2o")


EDGES = """EDGE_SE2 5 6 1 0 0.5 1 0 0 1 0 1
EDGE_SE2 6 9 1 0 0.5 1 0 0 1 0 1
EDGE_SE2 9 5 -1.2 0.4 -1 1 0 0 1 0 1
EDGE_SE2 20 21 0 2 0 1 0 0 1 0 1
"""


def test_edges_alone_are_chained_along_a_spanning_tree(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, EDGES))
    np.testing.assert_array_equal(graph.ids, [5, 6, 9, 20, 21])
    np.testing.assert_allclose(graph.poses[1], [1, 0, 0.5], atol=1e-12)
    # Node 9 is one edge from node 5: T_5_9 is the inverse of T_9_5.
    T = np.linalg.inv([[np.cos(-1), -np.sin(-1), -1.2], [np.sin(-1), np.cos(-1), 0.4], [0, 0, 1]])
    np.testing.assert_allclose(graph.poses[2], [T[0, 2], T[1, 2], 1.0], atol=1e-12)
    np.testing.assert_allclose(graph.poses[3:], [[0, 0, 0], [0, 2, 0]], atol=1e-12)
    assert optimize_pose_graph(graph).is_converged


def test_toro_writes_the_same_graphs_with_other_numbers(tmp_path: Path) -> None:
    planar = "VERTEX2 7 0 0 0\nVERTEX2 3 1 2 0.5\nFIX 3\nEDGE2 7 3 1.1 2.1 0.4 11 12 22 99 13 23\n"
    assert_same(read_g2o(written(tmp_path, planar)), read_g2o(written(tmp_path, PLANAR)))
    # iSAM's EDGE2 has the order of g2o; in that of TORO this matrix is not positive semidefinite.
    isam = PLANAR.replace("_SE2", "2").replace("11 12 13 22 23 99", "150 0 0 150 0 1100")
    np.testing.assert_array_equal(
        read_g2o(written(tmp_path, isam)).edges.information, [np.diag([150.0, 150.0, 1100.0])]
    )
    roots = np.random.default_rng(0).normal(size=(6, 6))
    numbers = " ".join(f"{x:.17g}" for x in (roots @ roots.T)[np.triu_indices(6)])
    roll, pitch, yaw = 0.1, -0.2, 0.3
    pose = f"1 2 3 {roll} {pitch} {yaw}"
    spatial = f"VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 {pose}\nEDGE3 0 1 {pose} {numbers}\n"
    graph = read_g2o(written(tmp_path, spatial))
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(graph.poses[1, :3, :3], turn, atol=1e-15)
    np.testing.assert_allclose(graph.edges.measurements[0, :3, 3], [1, 2, 3])
    np.testing.assert_allclose(graph.edges.information[0], roots @ roots.T, atol=1e-12)


def test_indefinite_information_names_its_edge_and_can_be_projected(tmp_path: Path) -> None:
    path = written(tmp_path, PLANAR + "EDGE_SE2 3 7 1 2 3 1 2 0 1 0 1\n")
    named = r"line 7: the information of edge 3 7 is not positive semidefinite, its least eigenvalue is -1"
    with pytest.raises(InputError, match=named):
        read_g2o(path)
    graph = read_g2o(path, nearest_psd=True)
    # Eigenvalues of [[1, 2], [2, 1]] are 3 and -1: what remains is 3 along (1, 1).
    np.testing.assert_allclose(graph.edges.information[1], [[1.5, 1.5, 0], [1.5, 1.5, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(graph.edges.information[0], read_g2o(written(tmp_path, PLANAR)).edges.information[0])


def test_real_graphs_of_users(real_data: Path) -> None:
    folder = real_data / "field_2d"
    found = optimize_pose_graph(read_g2o(folder / "CSAIL.g2o"))
    assert found.chi2 == pytest.approx(40.55, abs=0.02)
    graph = read_g2o(folder / "w100.graph")
    assert (len(graph.poses), len(graph.edges.source)) == (100, 300)
    assert optimize_pose_graph(graph).is_converged
    with pytest.raises(InputError, match=r"line 4: the information of edge 2655 2656 is not positive semidefinite"):
        read_g2o(folder / "cubicle_2edges.g2o")
    assert len(read_g2o(folder / "cubicle_2edges.g2o", nearest_psd=True).edges.source) == 2


def test_a_graph_of_one_pose_is_written_and_read(tmp_path: Path) -> None:
    nothing = Edges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
    path = write_g2o(tmp_path / "one.g2o", PoseGraph.create(np.eye(4)[None], nothing, ids=[7]))
    found = read_g2o(path)
    np.testing.assert_array_equal(found.ids, [7])
    assert len(found.edges.source) == 0

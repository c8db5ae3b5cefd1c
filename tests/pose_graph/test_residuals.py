"""The residuals against those of g2o and the matrix logarithm, in NumPy with 64 bits; nodes that edges leave free."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import logm

import dpmjax
from dpmjax.pose_graph import Edges, PoseGraph, find_free_nodes, optimize_pose_graph, residuals
from tests.pose_graph.test_optimize import GRAPHS, KINDS, difference, random_graph, to_matrix
from tests.tolerances import DOUBLE

# The least chi2 that was published for each graph of the plane, in g2o's definition (Carlone et al. 2016).
PUBLISHED = {"M3500": 137.913, "MITb": 41.163, "INTEL_stiff": 215.837}
# The chi2 that g2o (g2opy 2.3.0) computes at the poses of the file.
G2O_AT_START = {
    "M3500": 2566667.65920692,
    "MITb": 4414181662.524597,
    "INTEL_stiff": 5149721.044789,
    "intel": 551.73573084974,
}


@pytest.mark.parametrize("seed", [0, 1])
def test_residuals_in_the_plane_are_those_of_g2o(seed: int, float64) -> None:
    graph = random_graph(seed, 3, start=0.5)
    expected = [
        difference(*map(to_matrix, (measured, graph.poses[i], graph.poses[j])))
        for j, i, measured, _ in zip(*graph.edges, strict=True)
    ]
    np.testing.assert_allclose(residuals(graph.poses, graph.edges), expected, **DOUBLE)


@pytest.mark.parametrize("seed", [0, 1])
def test_residuals_in_space_are_matrix_logarithms(seed: int, float64) -> None:
    graph = random_graph(seed, 6, start=0.5)
    for (j, i, measured, _), found in zip(zip(*graph.edges, strict=True), residuals(*graph_arrays(graph)), strict=True):
        twist = logm(np.linalg.inv(measured) @ np.linalg.inv(graph.poses[i]) @ graph.poses[j]).real
        expected = [*twist[:3, 3], twist[2, 1], twist[0, 2], twist[1, 0]]
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


def graph_arrays(graph: PoseGraph) -> tuple[jax.Array, Edges]:
    return jnp.asarray(graph.poses), Edges(*map(jnp.asarray, graph.edges))


def test_graphs_of_the_host_refuse_traced_arrays_and_name_the_functions_that_take_them(as_user) -> None:
    graph = random_graph(0, 3)
    with pytest.raises(ValueError, match=r"^PoseGraph.create: runs on the host and .* call pose_graph.residuals or"):
        jax.jit(lambda poses: optimize_pose_graph(PoseGraph.create(poses, graph.edges)).chi2)(jnp.asarray(graph.poses))


def without_information(graph: PoseGraph, edge: int, *axes: int) -> PoseGraph:
    """The graph where one edge measures nothing about some axes."""
    information = graph.edges.information.copy()
    information[edge] = np.diag(np.isin(np.arange(graph.tangent_size), axes, invert=True).astype(float))
    # Only the chain is kept, so that no loop measures these axes, too.
    chain = [values[: len(graph.poses) - 1] for values in graph.edges._replace(information=information)]
    return PoseGraph.create(graph.poses, Edges(*chain), ids=10 * np.arange(len(graph.poses)))


@pytest.mark.parametrize(
    ("tangent", "axes", "names"),
    [
        (3, (2,), ("heading",)),
        (3, (0,), ("x",)),
        (3, (0, 1, 2), ("x", "y", "heading")),
        (6, (5,), ("rotation about z",)),
        (6, (1, 3), ("y", "rotation about x")),
    ],
)
def test_nodes_that_an_edge_leaves_free_are_named(tangent: int, axes: tuple[int, ...], names, caplog) -> None:
    graph = without_information(random_graph(0, tangent, noise=0.0, start=0.0), 4, *axes)
    with caplog.at_level(logging.WARNING, "dpmjax"):
        (free,) = optimize_pose_graph(graph).free_nodes
    assert free.ids[0] == 50
    assert sorted(free.ids) == [50, 60, 70]
    assert free.axes == names
    (warning,) = caplog.messages
    assert warning.startswith(f"no edge measures {', '.join(names)} of nodes 50, 60, 70;")


@KINDS
def test_nodes_that_a_second_edge_measures_are_not_free(tangent: int) -> None:
    graph = random_graph(0, tangent, noise=0.0, start=0.0)
    information = graph.edges.information.copy()
    information[4, -1] = information[4, :, -1] = 0  # the loops measure it
    assert find_free_nodes(PoseGraph.create(graph.poses, graph.edges._replace(information=information))) == ()
    assert find_free_nodes(graph) == ()


def test_nodes_without_an_edge_are_free_unless_they_are_fixed() -> None:
    poses = np.zeros((4, 3))
    edges = Edges(np.array([1]), np.array([0]), np.zeros((1, 3)), np.eye(3)[None])
    free = find_free_nodes(PoseGraph.create(poses, edges, ids=[5, 6, 7, 8]))
    assert [one.ids for one in free] == [(7,), (8,)]
    assert {one.axes for one in free} == {("x", "y", "heading")}
    free = find_free_nodes(PoseGraph.create(poses, edges, is_fixed=[False, False, True, True]))
    assert [one.ids for one in free] == [(0, 1)]


@pytest.mark.parametrize("name", G2O_AT_START)
def test_chi2_of_public_graphs_is_that_of_g2o(name: str, float64) -> None:
    graph = public_graph(name)
    error = residuals(graph.poses, graph.edges)
    chi2 = np.einsum("ei,eij,ej->", error, graph.edges.information, error)
    assert chi2 == pytest.approx(G2O_AT_START[name], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_public_graphs_of_the_plane_reach_the_published_minimum(name: str) -> None:
    solved = optimize_pose_graph(public_graph(name))
    assert solved.is_converged
    assert solved.iterations <= 15
    assert solved.chi2 == pytest.approx(PUBLISHED[name], rel=1e-4)


def public_graph(name: str) -> PoseGraph:
    path = GRAPHS / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"public graphs: set DPMJAX_DATA to the folder that has g2o/{path.name}")
    return dpmjax.read_g2o(path)

"""The solver against dense least squares in float64, written down without the library."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import dpmjax
from dpmjax.pose_graph import Edges, PoseGraph, PoseGraphConfig, optimize_pose_graph
from dpmjax.pose_graph.normal_equations import linearise

KINDS = pytest.mark.parametrize("tangent", [3, 6], ids=["plane", "space"])
# Of GTSAM 4.3, whose residuals in space are the same as here.
GTSAM_CHI2 = {"sphere2500": 1351.4019, "parking-garage": 1.2683848}
GRAPHS = Path(os.environ.get("DPMJAX_DATA", "../shared/data")) / "g2o"


def to_matrix(pose: np.ndarray) -> np.ndarray:
    """Matrices of x, y, heading; matrices stay."""
    if pose.shape == (4, 4):
        return pose
    x, y, heading = pose
    return np.array([[np.cos(heading), -np.sin(heading), x], [np.sin(heading), np.cos(heading), y], [0, 0, 1]])


def rotations(turn: np.ndarray) -> np.ndarray:
    """The rotation matrices of rotation vectors, or of headings."""
    if turn.shape[-1] == 3:
        return Rotation.from_rotvec(turn).as_matrix()
    return Rotation.from_rotvec(turn * [0.0, 0.0, 1.0]).as_matrix()[..., :2, :2]


def mean_rotation(turn: np.ndarray) -> np.ndarray:
    """Returns the mean rotation from none to the whole turn; it maps the translation of a twist to the motion's."""
    return rotations((np.arange(40)[:, None] + 0.5) / 40 * turn).mean(axis=0)


def exponential(twist: np.ndarray) -> np.ndarray:
    """The motion of a twist, to a few 1e-5 of its translation."""
    dim = 2 if len(twist) == 3 else 3
    T = np.eye(dim + 1)
    T[:dim, :dim], T[:dim, dim] = rotations(twist[dim:]), mean_rotation(twist[dim:]) @ twist[:dim]
    return T


def difference(measured: np.ndarray, target: np.ndarray, source: np.ndarray) -> np.ndarray:
    """The residual of one edge from homogeneous matrices: the pose itself in the plane, the twist in space."""
    T = np.linalg.inv(measured) @ np.linalg.inv(target) @ source
    if len(T) == 3:
        return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return np.concatenate([np.linalg.solve(mean_rotation(turn), T[:3, 3]), turn])


def random_graph(seed: int, tangent: int, *, count: int = 8, noise: float = 0.1, start: float = 0.1) -> PoseGraph:
    """A chain with loops; measurements are noisy, the start is off by `start`."""
    rng = np.random.default_rng(seed)
    true = [exponential(np.zeros(tangent))]
    for _ in range(count - 1):
        true.append(true[-1] @ exponential(np.array([1.0, *rng.uniform(-0.6, 0.6, tangent - 1)])))
    source = np.array([*range(1, count), count - 1, count - 2, 4])
    target = np.array([*range(count - 1), 0, 1, 1])
    measured = [
        np.linalg.inv(true[j]) @ true[i] @ exponential(noise * rng.normal(size=tangent))
        for i, j in zip(source, target, strict=True)
    ]
    poses = [true[0], *(T @ exponential(start * rng.normal(size=tangent)) for T in true[1:])]
    roots = rng.normal(size=(len(source), tangent, tangent)) + 3 * np.eye(tangent)
    edges = Edges(source, target, from_matrices(measured), roots @ np.swapaxes(roots, 1, 2))
    return PoseGraph.create(from_matrices(poses), edges)


def from_matrices(matrices: list[np.ndarray]) -> np.ndarray:
    stacked = np.stack(matrices)
    if stacked.shape[1] == 4:
        return stacked
    return np.stack([*stacked[:, :2, 2].T, np.arctan2(stacked[:, 1, 0], stacked[:, 0, 0])], axis=1)


def whitened(graph: PoseGraph, poses: list[np.ndarray]) -> np.ndarray:
    parts = [
        np.linalg.cholesky(information).T @ difference(to_matrix(measured), poses[j], poses[i])
        for i, j, measured, information in zip(*graph.edges, strict=True)
    ]
    return np.concatenate(parts)


def dense_chi2(graph: PoseGraph) -> float:
    """The least cost with the first pose held, by SciPy."""
    poses, tangent = [to_matrix(pose) for pose in graph.poses], graph.tangent_size

    def residuals(steps: np.ndarray) -> np.ndarray:
        moved = [T @ exponential(step) for T, step in zip(poses[1:], steps.reshape(-1, tangent), strict=True)]
        return whitened(graph, [poses[0], *moved])

    return 2 * least_squares(residuals, np.zeros(tangent * (len(poses) - 1))).cost


@KINDS
def test_minimum_is_that_of_dense_least_squares(tangent: int) -> None:
    graph = random_graph(0, tangent, count=6)
    solved = optimize_pose_graph(graph, PoseGraphConfig(tolerance=1e-10))
    assert solved.is_converged
    expected = (whitened(graph, list(map(to_matrix, graph.poses))) ** 2).sum()
    np.testing.assert_allclose(solved.chi2_initial, expected, rtol=1e-4)
    np.testing.assert_allclose(solved.chi2, dense_chi2(graph), rtol=1e-4)
    np.testing.assert_allclose(solved.chi2, optimize_pose_graph(solved.graph).chi2_initial, rtol=1e-9)
    np.testing.assert_array_equal(solved.graph.poses[0], graph.poses[0])
    np.testing.assert_array_equal(solved.weights, 1.0)


@KINDS
def test_edge_a_billion_times_stiffer_than_the_others_costs_few_steps(tangent: int) -> None:
    graph = random_graph(9, tangent, count=30, start=0.0)
    information = graph.edges.information.copy()
    information[11] *= 1e9
    stiff = PoseGraph.create(graph.poses, graph.edges._replace(information=information))
    solved = optimize_pose_graph(stiff, PoseGraphConfig(tolerance=1e-9))
    assert solved.is_converged
    assert solved.iterations <= 15
    # An edge that is a hundred times stiffer again changes nothing.
    information[11] *= 100
    stiffer = PoseGraph.create(graph.poses, graph.edges._replace(information=information))
    np.testing.assert_allclose(optimize_pose_graph(stiffer).chi2, solved.chi2, rtol=1e-4)


@KINDS
def test_derivatives_are_those_of_finite_differences(tangent: int) -> None:
    # Large residuals: there the derivative of the logarithm is far from the identity.
    graph = random_graph(1, tangent, start=0.4)
    still = np.zeros((len(graph.poses), tangent))
    at = linearise(graph.poses, graph.edges)
    gradient = np.zeros_like(still)
    np.add.at(gradient, np.stack([graph.edges.target, graph.edges.source], axis=1), at.gradient)
    expected = np.zeros_like(still)
    for index in np.ndindex(still.shape):
        step = still.copy()
        step[index] = 1e-5
        forward, backward = (linearise(graph.poses, graph.edges, sign * step).chi2.sum() for sign in (1, -1))
        expected[index] = (forward - backward) / 4e-5
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-5)
    # J^T W J of a whole edge is symmetric, and its gradient is J^T W r: their lengths belong together.
    blocks = np.moveaxis(at.blocks, 3, 2).reshape(-1, 2 * tangent, 2 * tangent)
    np.testing.assert_allclose(blocks, np.swapaxes(blocks, 1, 2), rtol=1e-9, atol=1e-9)
    flat = at.gradient.reshape(-1, 2 * tangent)
    np.testing.assert_allclose(np.einsum("ei,eij,ej->e", flat, np.linalg.pinv(blocks), flat), at.chi2, rtol=1e-6)


@KINDS
def test_minimum_does_not_depend_on_the_world(tangent: int) -> None:
    graph = random_graph(2, tangent)
    world = exponential(np.random.default_rng(5).uniform(-2, 2, tangent))
    moved = PoseGraph.create(from_matrices([world @ to_matrix(pose) for pose in graph.poses]), graph.edges)
    config = PoseGraphConfig(tolerance=1e-10)
    plain, other = optimize_pose_graph(graph, config), optimize_pose_graph(moved, config)
    np.testing.assert_allclose(other.chi2, plain.chi2, rtol=1e-7)
    expected = [world @ to_matrix(pose) for pose in plain.graph.poses]
    np.testing.assert_allclose([to_matrix(pose) for pose in other.graph.poses], expected, atol=1e-5)


@KINDS
def test_chordal_start_solves_a_graph_without_any_first_guess(tangent: int) -> None:
    graph = random_graph(3, tangent, noise=0.02)
    unknown = PoseGraph.create(from_matrices([exponential(np.zeros(tangent))] * len(graph.poses)), graph.edges)
    solved = optimize_pose_graph(unknown)
    np.testing.assert_allclose(solved.chi2, optimize_pose_graph(graph).chi2, rtol=1e-4)
    assert solved.chi2_initial > 100 * solved.chi2


@KINDS
def test_kernel_lets_a_wrong_loop_go(tangent: int) -> None:
    graph = random_graph(4, tangent, noise=0.0, start=0.02)
    measurements = graph.edges.measurements.copy()
    wrong = exponential(np.array([6.0, -5.0, *[0.5] * (tangent - 2)]))
    measurements[-1] = from_matrices([to_matrix(measurements[-1]) @ wrong])[0]
    torn = PoseGraph.create(graph.poses, graph.edges._replace(measurements=measurements))
    steps_count_more = np.repeat([30.0, 1.0], [7, 3])
    config = PoseGraphConfig(outlier_chi2=10.0, tolerance=1e-9)
    solved = optimize_pose_graph(torn, config, trust=steps_count_more)
    assert solved.weights[-1] < 1e-3
    assert solved.weights[:-1].min() > 0.95
    true = optimize_pose_graph(graph).graph
    poses = [[to_matrix(pose) for pose in g.poses] for g in (solved.graph, true)]
    np.testing.assert_allclose(*poses, atol=0.02)
    # Enough trust in the wrong edge, and it stays.
    trusted = optimize_pose_graph(torn, config, trust=np.append(np.ones(9), 1e6))
    assert trusted.weights[-1] > 0.9


@KINDS
def test_each_part_of_a_graph_keeps_a_node(tangent: int) -> None:
    graph = random_graph(5, tangent)
    is_kept = np.arange(len(graph.edges.source)) != 3
    cut = PoseGraph.create(graph.poses, Edges(*(x[is_kept & (graph.edges.target > 1)] for x in graph.edges)))
    solved = optimize_pose_graph(cut)
    assert solved.is_converged
    # Nodes 0 and 1 have no edge, 2 and 3 are a part, 4 to 7 another one.
    np.testing.assert_array_equal(solved.graph.poses[[0, 1, 2, 4]], cut.poses[[0, 1, 2, 4]])
    assert np.isfinite(solved.graph.poses).all()


def test_fixed_nodes_stay_and_the_others_move() -> None:
    graph = random_graph(6, 3)
    is_fixed = np.isin(np.arange(8), [3, 7])
    solved = optimize_pose_graph(PoseGraph.create(graph.poses, graph.edges, is_fixed=is_fixed))
    is_still = (solved.graph.poses == graph.poses).all(axis=1)
    np.testing.assert_array_equal(is_still, is_fixed)
    np.testing.assert_array_equal(solved.graph.is_fixed, is_fixed)


def test_edges_without_information_leave_their_poses_finite() -> None:
    graph = random_graph(7, 3)
    nothing = graph.edges._replace(information=0 * graph.edges.information)
    solved = optimize_pose_graph(PoseGraph.create(graph.poses, nothing))
    assert solved.chi2 == 0.0
    np.testing.assert_array_equal(solved.graph.poses, graph.poses)


def test_graph_without_edges_is_solved_already() -> None:
    none = np.zeros(0, int)
    edges = Edges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    solved = optimize_pose_graph(PoseGraph.create([[1.0, 2.0, 3.0]], edges))
    assert (solved.chi2, solved.chi2_initial, solved.is_converged) == (0.0, 0.0, True)


def test_second_graph_of_a_like_size_compiles_nothing(assert_compiles_nothing) -> None:
    optimize_pose_graph(random_graph(0, 3))
    with assert_compiles_nothing():
        optimize_pose_graph(random_graph(1, 3, count=11))
    assert not jax.config.jax_enable_x64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": np.zeros((8, 2))}, "^poses: expected shape"),
        ({"poses": np.full((8, 3), np.nan)}, "^poses: expected finite numbers, .* row 0"),
        ({"source": np.full(10, 8)}, "^source: expected rows of nodes"),
        ({"source": np.zeros(10)}, "^source: expected another node"),
        ({"measurements": np.zeros((10, 4, 4))}, "^measurements: expected shape"),
        ({"information": -np.tile(np.eye(3), (10, 1, 1))}, "^information: expected symmetric, positive"),
        ({"ids": np.zeros(8)}, "^ids: expected every id once"),
        ({"is_fixed": np.zeros(3, bool)}, "^is_fixed: expected shape"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_graph_is_refused_in_one_line(changes: dict, message: str, as_user) -> None:
    graph = random_graph(8, 3)
    of_edges = {name: value for name, value in changes.items() if name in Edges._fields}
    others = {name: value for name, value in changes.items() if name not in of_edges}
    with pytest.raises(ValueError, match=message):
        PoseGraph.create(**({"poses": graph.poses} | others), edges=graph.edges._replace(**of_edges))


@pytest.mark.slow
@pytest.mark.parametrize("name", GTSAM_CHI2)
def test_public_graphs_in_space_reach_the_minimum_of_gtsam(name: str) -> None:
    path = GRAPHS / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"public graphs: set DPMJAX_DATA to the folder that has g2o/{path.name}")
    assert dpmjax.optimize_pose_graph(dpmjax.read_g2o(path)).chi2 == pytest.approx(GTSAM_CHI2[name], rel=1e-5)

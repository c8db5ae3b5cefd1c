import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, PoseGraph, join_rows
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.slam.planar.joint import solve_step


def loop_of(num_poses: int = 40) -> np.ndarray:
    angle = np.linspace(0.0, 3 * np.pi, num_poses)
    return np.stack([50 * np.sin(angle), 50 - 50 * np.cos(angle), se2.wrap_angle(angle)], -1)


def edges_of(poses: np.ndarray, source: np.ndarray, target: np.ndarray) -> Edges:
    information = np.broadcast_to(np.diag([1.0, 1.0, 100.0]), (len(source), 3, 3))
    return Edges(source, target, se2.relative(poses[target], poses[source]), information)


@pytest.mark.parametrize("seed", [0, 1])
def test_sparse_step_is_that_of_the_dense_system(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, num_edges = 7, 16
    source = np.append(np.arange(1, count), rng.integers(1, count, num_edges - count + 1))
    others = (source[count - 1 :] + rng.integers(1, count, num_edges - count + 1)) % count
    target = np.append(np.arange(count - 1), others)
    roots = rng.normal(size=(num_edges, 3, 3))
    edges = Edges(source, target, rng.normal(size=(num_edges, 3)), roots @ np.swapaxes(roots, 1, 2))
    residual = rng.normal(size=(num_edges, 3))
    gradient = np.einsum("eij,ej->ei", edges.information, residual)
    # Least squares over all edges: J (delta_i - Ad(T_i_j) delta_j) + J r, first pose held.
    rows = np.zeros((3 * num_edges, 3 * count))
    right = np.zeros(3 * num_edges)
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        part, root = slice(3 * e, 3 * e + 3), np.linalg.cholesky(edges.information[e]).T
        rows[part, 3 * i : 3 * i + 3] += root
        rows[part, 3 * j : 3 * j + 3] -= root @ se2.adjoint(se2.inverse(edges.measurements[e]))
        right[part] = -root @ residual[e]
    expected = np.linalg.lstsq(rows[:, 3:], right, rcond=None)[0].reshape(-1, 3)
    step = solve_step(count, edges, gradient)
    np.testing.assert_allclose(step[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(step[1:], expected, rtol=1e-4, atol=1e-5)


def test_a_torn_loop_is_recovered_although_a_fifth_of_the_loops_lie() -> None:
    rng = np.random.default_rng(3)
    true = loop_of()
    # The second round sees the first one again; the steps drift by a degree each.
    source, target = np.repeat(np.arange(28, 40), 2), np.tile([0, 1], 12) + np.repeat(np.arange(0, 12), 2)
    loops = edges_of(true, source, target)
    is_wrong = np.arange(len(source)) % 5 == 0
    lies = loops.measurements + is_wrong[:, None] * rng.uniform(20, 40, (len(source), 3)) * [1, -1, 0.05]
    steps = edges_of(true, np.arange(1, 40), np.arange(39))
    drifted = steps._replace(measurements=steps.measurements + np.array([0.0, 0.0, np.radians(1.0)]))
    start = se2.compose(true[:1], se2.chain(drifted.measurements))
    graph = PoseGraph.create(start, join_rows(drifted, loops._replace(measurements=lies)))
    solved = optimize_pose_graph(graph, ROBUST, trust=np.repeat([30.0, 1.0], [39, len(source)]))
    found, weight = solved.graph.poses, solved.weights
    before = np.hypot(*(start - true)[:, :2].T).max()
    after = np.hypot(*(found - true)[:, :2].T).max()
    assert before > 20.0
    assert after < 5.0
    assert weight[39:][is_wrong].max() < 0.1
    assert weight[39:][~is_wrong].min() > 0.5
    np.testing.assert_allclose(found[0], start[0], atol=1e-5)

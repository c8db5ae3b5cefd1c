"""Covariances of poses against a dense inverse by finite differences, and against solutions of drawn measurements."""

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.pose_graph import PoseGraph, PoseGraphConfig, free_nodes, optimize_pose_graph, pose_covariances
from tests.pose_graph.test_optimize import KINDS, exponential, from_matrices, random_graph, to_matrix, whitened


def dense_covariances(graph: PoseGraph) -> np.ndarray:
    """Blocks of the inverse of J^T J, J of the whitened residuals by central differences; the first pose is held."""
    poses, size = [to_matrix(pose) for pose in graph.poses], graph.tangent_size
    columns = []
    for node in range(1, len(poses)):
        for axis in range(size):
            ends = []
            for sign in (1.0, -1.0):
                moved = list(poses)
                moved[node] = poses[node] @ exponential(sign * 1e-4 * np.eye(size)[axis])
                ends.append(whitened(graph, moved))
            columns.append((ends[0] - ends[1]) / 2e-4)
    jacobian = np.stack(columns, axis=1)
    inverse = np.linalg.inv(jacobian.T @ jacobian).reshape(len(poses) - 1, size, len(poses) - 1, size)
    return inverse[np.arange(len(poses) - 1), :, np.arange(len(poses) - 1)]


@KINDS
def test_covariances_are_blocks_of_the_dense_inverse(tangent: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_nodes, "_BATCH", 4)  # two batches
    solved = optimize_pose_graph(random_graph(3, tangent, noise=0.02, start=0.02)).graph
    found = pose_covariances(solved)
    np.testing.assert_array_equal(found[0], 0.0)
    wanted = dense_covariances(solved)
    np.testing.assert_allclose(found[1:], wanted, rtol=2e-3, atol=2e-3 * wanted.max())


def test_poses_of_drawn_measurements_spread_as_predicted() -> None:
    graph = optimize_pose_graph(random_graph(5, 3, noise=0.0, start=0.0)).graph
    information = np.tile(np.eye(3) * 1e4, (len(graph.edges.source), 1, 1))
    graph = replace(graph, edges=graph.edges._replace(information=information))
    rng = np.random.default_rng(0)
    steps = []
    for _ in range(100):
        noisy = [to_matrix(T) @ exponential(0.01 * rng.normal(size=3)) for T in graph.edges.measurements]
        drawn = replace(graph, edges=graph.edges._replace(measurements=from_matrices(noisy)))
        solved = optimize_pose_graph(drawn, PoseGraphConfig(is_chordal_start=False)).graph
        last = np.linalg.inv(to_matrix(graph.poses[-1])) @ to_matrix(solved.poses[-1])
        steps.append([last[0, 2], last[1, 2], np.arctan2(last[1, 0], last[0, 0])])
    spread = np.std(steps, axis=0)
    predicted = np.sqrt(np.diagonal(pose_covariances(graph)[-1]))
    # 100 draws tell a deviation to 7 % (1 sigma).
    np.testing.assert_allclose(spread, predicted, rtol=0.2)


def test_free_node_is_infinitely_uncertain() -> None:
    graph = random_graph(0, 3, count=6)
    information = graph.edges.information.copy()
    information[(graph.edges.source == 3) | (graph.edges.target == 3)] = 0.0
    found = pose_covariances(replace(graph, edges=graph.edges._replace(information=information)))
    assert not np.isfinite(found[3]).any()

"""A pose graph with edges of your own, robust against a wrong one, and the gradient of its solution."""

import jax
import jax.numpy as jnp
import numpy as np

import dpmjax
from dpmjax import pose_graph
from dpmjax.geometry import se2

# Twelve poses on a circle; each edge measures T_target_source: the later pose in the frame of the earlier one.
turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
truth = np.stack([5.0 * np.sin(turns), 5.0 * (1.0 - np.cos(turns)), turns], axis=1)
source, target = np.arange(1, 12), np.arange(0, 11)
motions = se2.relative(truth[target], truth[source]) + np.random.default_rng(0).normal(0, 0.005, (11, 3))

# Two loops: the last pose seen from the first one, right, and another that is 4 m wrong.
loops = se2.relative(truth[[0, 2]], truth[[11, 8]]) + np.array([[0, 0, 0], [4, 0, 0]])
measured, information = np.concatenate([motions, loops]), np.tile(np.eye(3) / 0.005**2, (13, 1, 1))
edges = dpmjax.Edges(np.r_[source, 11, 8], np.r_[target, 0, 2], measured, information)
start = se2.chain(motions)  # the path of the motions alone
graph = dpmjax.PoseGraph.create(start, edges)
for name, config in (("least squares", None), ("robust", dpmjax.PoseGraphConfig(outlier_chi2=10.0))):
    solved = dpmjax.optimize_pose_graph(graph, config)
    error = dpmjax.absolute_trajectory_error(solved.graph.poses[:, :2], truth[:, :2])
    print(f"{name}: ATE {error:.3f} m, weight of the wrong loop {solved.weights[-1]:.2f}")


def last_x(measurements):
    """Returns the x coordinate of the last pose as a function of all measurements."""
    return pose_graph.solve_dense(jnp.asarray(start), edges._replace(measurements=measurements)).poses[-1, 0]


slope = jax.grad(last_x)(jnp.asarray(edges.measurements))
print("d x of the last pose / d measurement, first step and right loop:", slope[0].round(2), slope[11].round(2))

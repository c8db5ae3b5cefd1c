"""The traced solver: the minimum of the host's solver, padding, batches, gradients against differences in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import rigid, se2
from dpmjax.pose_graph import Edges, PoseGraphConfig, optimize_pose_graph, solve_dense
from tests.pose_graph.test_optimize import KINDS, random_graph


def arrays_of(seed: int, tangent: int, **options: float) -> tuple[jax.Array, Edges]:
    graph = random_graph(seed, tangent, **options)
    return jnp.asarray(graph.poses), Edges(*map(jnp.asarray, graph.edges))


def moved(poses: jax.Array, step: jax.Array) -> jax.Array:
    return se2.compose(poses, step) if poses.ndim == 2 else rigid.matmul(poses, rigid.exp(step))


@pytest.mark.slow
@KINDS
def test_minimum_is_that_of_the_sparse_solver(tangent: int, float64) -> None:
    graph = random_graph(0, tangent)
    expected = optimize_pose_graph(graph, PoseGraphConfig(tolerance=1e-12, is_chordal_start=False))
    found = solve_dense(*arrays_of(0, tangent))
    assert found.converged
    np.testing.assert_allclose(found.chi2, expected.chi2, rtol=1e-9)
    np.testing.assert_allclose(found.poses, expected.graph.poses, atol=1e-6)
    np.testing.assert_array_equal(found.poses[0], graph.poses[0])
    assert not solve_dense(*arrays_of(0, tangent), num_steps=1).converged


def test_fixed_nodes_and_those_without_an_edge_stay() -> None:
    poses, edges = arrays_of(1, 3)
    is_fixed = jnp.isin(jnp.arange(8), jnp.array([3, 7]))
    found = solve_dense(poses, edges, is_fixed=is_fixed)
    np.testing.assert_array_equal(found.poses[is_fixed], poses[is_fixed])
    assert np.abs(found.poses - poses)[~is_fixed].min() > 0
    np.testing.assert_array_equal(solve_dense(poses, edges, is_fixed=jnp.ones(8, bool)).poses, poses)
    none = solve_dense(poses, edges, edge_mask=jnp.zeros(len(edges.source), bool))
    np.testing.assert_array_equal(none.poses, poses)
    assert (float(none.chi2), bool(none.converged)) == (0.0, True)


@pytest.mark.slow
@KINDS
def test_gradient_is_that_of_differences(tangent: int, float64) -> None:
    poses, edges = arrays_of(3, tangent, count=6, noise=0.03, start=0.05)
    rng = np.random.default_rng(4)
    reading = jnp.asarray(rng.normal(size=poses.shape))
    num_edges = len(edges.source)
    roots = rng.normal(size=(num_edges, tangent, tangent))
    along = {
        "measurements": jnp.asarray(rng.normal(size=(num_edges, tangent))),
        "information": jnp.asarray(roots + np.swapaxes(roots, 1, 2)),
        "fixed": jnp.asarray(rng.normal(size=(1, tangent))),
    }

    def read(change: dict[str, jax.Array]) -> jax.Array:
        measurements = moved(edges.measurements, change["measurements"])
        changed = edges._replace(measurements=measurements, information=edges.information + change["information"])
        given = jnp.concatenate([moved(poses[:1], change["fixed"]), poses[1:]])
        found = solve_dense(given, changed)
        return jnp.sum(reading * found.poses) + found.chi2

    function = jax.jit(read)
    still = jax.tree.map(jnp.zeros_like, along)
    gradient = jax.jit(jax.grad(read))(still)
    for name, direction in along.items():
        ends = [function(still | {name: step * direction}) for step in (1e-5, -1e-5)]
        slope = float((ends[0] - ends[1]) / 2e-5)
        assert abs(slope) > 1e-3
        assert float(jnp.sum(gradient[name] * direction)) == pytest.approx(slope, rel=1e-6, abs=1e-6), name


def test_start_of_free_nodes_has_no_gradient() -> None:
    poses, edges = arrays_of(5, 3)
    gradient = jax.grad(lambda poses: jnp.sum(jnp.cos(solve_dense(poses, edges).poses)))(poses)
    np.testing.assert_array_equal(gradient[1:], 0.0)
    assert np.abs(gradient[0]).min() > 1e-3


def test_number_that_no_edge_measures_has_no_gradient_and_the_others_stay_finite(float64) -> None:
    poses, edges = arrays_of(6, 3)
    chain = Edges(*(values[:7] for values in edges))
    chain = chain._replace(information=chain.information.at[4].set(jnp.diag(jnp.array([1.0, 1.0, 0.0]))))

    def last(measurements: jax.Array) -> jax.Array:
        return solve_dense(poses, chain._replace(measurements=measurements)).poses[5, 2]

    heading, gradient = jax.value_and_grad(last)(chain.measurements)
    assert np.isfinite(heading)
    assert np.isfinite(gradient).all()
    assert gradient[4, 2] == pytest.approx(0.0, abs=1e-8)
    assert np.abs(gradient[3]).max() > 1e-3

"""A wrong argument of a kernel of geometry, a loss or a graph is named in the first words of its error."""

import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax.geometry import find_consensus, rigid, typical_range
from dpmjax.geometry.pyramid import PyramidConfig, build_pyramid, build_pyramid_on_host
from dpmjax.losses import offset_loss
from dpmjax.pose_graph import Edges, residuals, solve_dense

ONES, NOTHING, CONFIG = np.ones((4, 3), np.float32), np.zeros((0, 3), np.float32), PyramidConfig()
SHAPES = {
    "source": [((5, 4), (5, 4), (5,)), ((5,), (5,), (5,))],
    "target": [((5, 3), (6, 3), (5,)), ((5, 3), (5, 2), (5,))],
    "weights": [((5, 3), (5, 3), (6,))],
}
POSES, ROWS = jnp.zeros((8, 3)), jnp.arange(7)
EDGES = Edges(ROWS + 1, ROWS, jnp.zeros((7, 3)), jnp.tile(jnp.eye(3), (7, 1, 1)))
CONTRAST = {"queries": ONES, "keys": np.ones((9, 3), np.float32), "positives": np.zeros(4, np.int32)}
CONTRASTS = [
    ({"keys": np.ones((9, 2), np.float32)}, "keys: expected shape"),
    ({"positives": np.zeros(3, np.int32)}, "positives: expected shape"),
    ({"positives": np.zeros(4)}, "positives: expected integers"),
    ({"ignore": np.zeros((9, 4), bool)}, "ignore: expected bool of shape"),
    ({"mask": np.ones(4)}, "mask: expected bool"),
    ({"temperature": 0.0}, "temperature: expected a number above 0"),
]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *(
            (lambda given=given: dpmjax.weighted_svd(*map(jnp.ones, given)), f"{name}: expected shape")
            for name, shapes in SHAPES.items()
            for given in shapes
        ),
        (lambda: find_consensus(ONES[:3], ONES), "target: expected shape"),
        (lambda: dpmjax.k_nearest(ONES[0], ONES, 1), "queries: expected shape"),
        (lambda: dpmjax.k_nearest(ONES.astype(object), ONES, 1), "queries: expected real numbers, got dtype"),
        (lambda: dpmjax.k_nearest(ONES.astype(complex), ONES, 1), "queries: expected real numbers, got dtype"),
        (lambda: dpmjax.k_nearest(ONES, ONES[:, :2], 1), "points: expected 3 columns"),
        (lambda: dpmjax.k_nearest(ONES, ONES, 1, jnp.ones(3, bool)), "mask: expected bool of shape"),
        (lambda: dpmjax.k_nearest(ONES, ONES, 1, jnp.ones(4)), "mask: expected bool"),
        (lambda: dpmjax.k_nearest(ONES, ONES, 0), "k: expected at least 1"),
        (lambda: dpmjax.radius_search(ONES, ONES, 0.0, 1), "radius: expected a number above 0"),
        (lambda: dpmjax.estimate_normals(jnp.ones((5, 4)), 3), "points: expected shape"),
        (lambda: dpmjax.estimate_normals(ONES, 2), "k: expected at least 3"),
        (lambda: build_pyramid(ONES[:, :2], None, CONFIG), "points: expected shape"),
        (lambda: build_pyramid(NOTHING, None, CONFIG), "points: expected at least one"),
        (lambda: build_pyramid_on_host(ONES[:, :2], None, CONFIG), "points: expected shape"),
        (lambda: build_pyramid_on_host(NOTHING, None, CONFIG), "points: expected shape"),
        (lambda: build_pyramid_on_host(ONES, np.ones(3, bool), CONFIG), "mask: expected bool"),
        (lambda: build_pyramid_on_host(ONES, None, CONFIG, num_threads=0), "num_threads: expected at least 1"),
        (lambda: PyramidConfig(stages=CONFIG.stages[::-1]), "stages: expected no stage"),
        (lambda: PyramidConfig(num_interpolations=5), "num_interpolations: expected"),
        (lambda: dpmjax.sample_free_space(jnp.zeros(3), jnp.zeros((4, 2)), jnp.ones(3)), "origin: expected shape"),
        (
            lambda: dpmjax.sample_free_space(jnp.zeros(2), jnp.zeros((4, 2)), jnp.ones((5, 3))),
            "factors: expected shape",
        ),
        (lambda: typical_range(np.ones((2, 3, 2)), np.zeros((2, 3), bool)), "mask: expected at least one valid beam"),
        (lambda: rigid.exp(np.zeros((2, 4), np.float32)), "tangent: expected"),
        (lambda: rigid.transform_points(jnp.eye(4), jnp.ones((5, 2))), "T_a_b: expected shape"),
        (lambda: dpmjax.farthest_point_sample(NOTHING, 4), "points: expected at least one"),
        (lambda: dpmjax.farthest_point_sample(ONES, 0), "num_samples: expected at least 1"),
        (lambda: dpmjax.voxel_sample(ONES, -1.0), "voxel_size: expected a number above 0"),
        (lambda: dpmjax.chamfer_distance(ONES[:, :2], ONES), "b: expected 2 columns"),
        (lambda: dpmjax.chamfer_distance(ONES, ONES, None, jnp.ones(3, bool)), "mask_b: expected bool of shape"),
        (lambda: dpmjax.chamfer_distance(ONES, ONES, max_distance=-1.0), "max_distance: expected a number above 0"),
        *((lambda given=given: dpmjax.info_nce(**(CONTRAST | given)), message) for given, message in CONTRASTS),
        (lambda: dpmjax.occupancy_loss(ONES[:, :2], ONES, ONES[:, :2]), "labels: expected a shape"),
        (lambda: dpmjax.occupancy_loss(ONES, ONES, jnp.ones((5, 4, 3))), "weights: expected a shape"),
        (lambda: residuals(POSES[:, :2], EDGES), "poses: expected shape"),
        (lambda: residuals(POSES, EDGES._replace(information=EDGES.information[1:])), "information: expected shape"),
        (lambda: solve_dense(POSES, EDGES, is_fixed=jnp.ones(7, bool)), "is_fixed: expected bool"),
        (lambda: solve_dense(POSES, EDGES, num_steps=0), "num_steps: expected at least 1"),
        (lambda: offset_loss(ONES, np.ones((5, 3))), "true: expected shape"),
        (lambda: offset_loss(ONES, ONES, np.ones(3, bool)), "mask: expected"),
    ],
)
def test_wrong_arguments_are_named(call, message: str, as_user) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()

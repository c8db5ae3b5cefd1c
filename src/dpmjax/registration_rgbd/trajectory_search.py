"""Initial poses of depth images by a beam search over trajectories, image after image.

Several motions of the next image are proposed for each trajectory. The trajectories that explain the largest share of
the points are kept, as far as they differ, so that later images resolve ambiguous motions. After each image the poses
of each trajectory are adjusted. At the end they are adjusted at a finer tolerance, and the best trajectory is chosen.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.geometry.sampling import typical_range
from dpmjax.geometry.se3 import Motion
from dpmjax.registration_rgbd.depth_images import DepthScans, PixelSample, SampledImages, Views
from dpmjax.registration_rgbd.motion_search import (
    MAX_TRANSLATION,
    MAX_TURN_DEG,
    DepthSearchConfig,
    SearchCamera,
    depth_search,
    motion_cost,
    propose_motions,
    surface_directions,
)
from dpmjax.registration_rgbd.projective_consistency import adjust_poses, explained_share

# Least root mean square difference of two trajectories, as shares of the largest translation and of the largest turn.
_APART = (0.085, 0.075)
# Weight of the cost of motions relative to the explained share.
_MOTION_COST = 3.0
# Number of searches for an image with few trajectories, each with other points; with more trajectories, number of
# searches in addition to one for each.
_NUM_TRIES = 4
# Largest difference of the explained share of a kept trajectory from that of the best one.
_MARGIN = 0.25
# Number of points of each image in a search, and in the comparison and adjustment of trajectories.
_NUM_POINTS, _NUM_COMPARED = 100, 300
# Number of last images by which incomplete trajectories are compared and adjusted.
_NUM_WINDOW = 24
# Number of steps of an adjustment.
_NUM_ITERATIONS = 6
# Number of trajectories in the last adjustment, and of its tolerances.
_NUM_LAST, _NUM_TOLERANCES = 4, 3


def initialize_depth(
    scans: DepthScans,
    config: DepthSearchConfig | None = None,
    *,
    key: jax.Array,
    on_image: Callable[[int, int], None] = lambda num_placed, num_all: None,
) -> NDArray[np.float64]:
    """Searches initial poses of all images, the first at the origin.

    Args:
        scans: images in order of time, metres; neighbours overlap.
        config: settings of the search; None: `depth_search("planar")`.
        key: key of the search.
        on_image: called with the number of images that have poses and of all images, before the search of each.

    Returns:
        (n, 4, 4) T_world_camera, metres.
    """
    config = config or depth_search("planar")
    sample_key, search_key = jax.random.split(key)
    surfaces, directions = scans.surfaces, jnp.asarray(surface_directions(scans, config.motion))
    unit = typical_range(scans.points, scans.mask)
    images = SampledImages(scans, _sample(scans, _NUM_COMPARED, key=sample_key), unit)
    camera = SearchCamera(scans.pinhole, unit)
    views = [
        Views(_sample(scans, _NUM_POINTS, key=jax.random.fold_in(sample_key, k)), surfaces)
        for k in range(config.num_trajectories + _NUM_TRIES)
    ]
    T = np.eye(4)[None, None]
    num_images = scans.mask.shape[0]
    for scan in range(1, num_images):
        on_image(scan, num_images)
        # One search for each trajectory, and more for the best ones, each with other points.
        num_searches = _NUM_TRIES if len(T) < _NUM_TRIES else len(T) + _NUM_TRIES
        continued = []
        for k, search_key_k in enumerate(jax.random.split(jax.random.fold_in(search_key, scan), num_searches)):
            before = T[k % len(T)]
            T_last_next = propose_motions(before, views[k], directions, camera, config, key=search_key_k)
            poses = np.broadcast_to(before, (len(T_last_next), *before.shape))
            continued.append(np.concatenate([poses, (before[-1] @ T_last_next)[:, None]], axis=1))
        T = _best_that_differ(np.stack(continued), images, config)
        T = _adjusted(T, images, config.scales.tolerance[1], config.motion)
    on_image(num_images, num_images)
    return _best_at_finer_tolerance(T[:_NUM_LAST], SampledImages(scans, scans.pixels, unit), config)


def _best_at_finer_tolerance(
    T: NDArray[np.float64], images: SampledImages, config: DepthSearchConfig
) -> NDArray[np.float64]:
    """Adjusts all poses of trajectories at falling tolerances, and selects the best trajectory."""
    final = config.scales.final_tolerance
    for tolerance in np.geomspace(config.scales.tolerance[1], final, _NUM_TOLERANCES):
        T = _adjusted(T, images, float(tolerance), config.motion, num_window=T.shape[1])
    scores = _explained(jnp.asarray(T, jnp.float32), images, jnp.asarray(final))
    return T[np.argmax(np.asarray(scores) - _mean_cost(T, config))]


def _sample(scans: DepthScans, count: int, *, key: jax.Array) -> PixelSample:
    """Draws points of each image."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    points, mask = (np.asarray(values) for values in scans.pixels)
    some = [p[rng.choice(np.flatnonzero(m), count)] for p, m in zip(points, mask, strict=True)]
    return PixelSample(jnp.asarray(np.stack(some)), jnp.ones((len(some), count), bool))


def _window(num_placed: int, images: SampledImages, num_window: int) -> tuple[NDArray[np.intp], SampledImages]:
    """Returns rows of the last images with a pose, and these images, padded with fully masked images."""
    length = min(num_window, images.scans.mask.shape[0])
    rows = max(num_placed - length, 0) + np.arange(length)
    is_placed = jnp.asarray(rows < num_placed)
    scans, sample, unit = images
    seen = DepthScans(scans.points[rows], scans.mask[rows] & is_placed[:, None, None], scans.pinhole)
    some = PixelSample(sample.points[rows], sample.mask[rows] & is_placed[:, None])
    return np.minimum(rows, num_placed - 1), SampledImages(seen, some, unit)


def _mean_cost(T: NDArray[np.float64], config: DepthSearchConfig) -> NDArray[np.float64]:
    """Computes the mean cost of the motions of each trajectory."""
    motions = np.linalg.inv(T[:, :-1]) @ T[:, 1:]
    costs = motion_cost(np.linalg.norm(motions[..., :3, 3], axis=-1), _turns(motions), config)
    return _MOTION_COST * costs.mean(axis=1)


def _turns(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the angles of (..., 4, 4) motions, radians."""
    return Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).magnitude().reshape(T.shape[:-2])


@jax.jit
def _explained(T: Float[Array, "m n 4 4"], images: SampledImages, tolerance: Float[Array, ""]) -> Float[Array, " m"]:
    """Computes the explained share of each trajectory."""
    return jax.lax.map(lambda one: explained_share(one, images, tolerance), T)


def _best_that_differ(T: NDArray[np.float64], images: SampledImages, config: DepthSearchConfig) -> NDArray[np.float64]:
    """Selects the best of (t, k, m, 4, 4) trajectories that differ from all better ones, best first."""
    rows, window = _window(T.shape[2], images, _NUM_WINDOW)
    tolerance = jnp.asarray(config.scales.tolerance[1])
    scores = np.concatenate([_explained(jnp.asarray(t[:, rows], jnp.float32), window, tolerance) for t in T])
    T = T.reshape(-1, *T.shape[2:])
    scores = scores - _mean_cost(T, config)
    far, turn = _APART[0] * MAX_TRANSLATION, _APART[1] * np.deg2rad(MAX_TURN_DEG)
    is_left, kept = scores >= scores.max() - _MARGIN, list[NDArray[np.float64]]()
    while is_left.any() and len(kept) < config.num_trajectories:
        best = T[np.argmax(np.where(is_left, scores, -np.inf))]
        kept.append(best)
        apart = np.sqrt(np.mean(np.sum((T[..., :3, 3] - best[:, :3, 3]) ** 2, axis=-1), axis=-1))
        turned = _turns(np.linalg.inv(best) @ T).max(axis=-1)
        is_left &= (apart >= far) | (turned >= turn)
    return np.stack(kept)


def _adjusted(
    T: NDArray[np.float64], images: SampledImages, tolerance: float, motion: Motion, *, num_window: int = _NUM_WINDOW
) -> NDArray[np.float64]:
    """Adjusts the last poses of trajectories, as long as the consistency grows; the first pose is fixed."""
    rows, window = _window(T.shape[1], images, num_window)
    num_placed = rows[-1] - rows[0] + 1
    T = T.copy()
    for one in T:
        before = jnp.asarray(one[rows], jnp.float32)
        motions = adjust_poses(before, window, tolerance, num_iterations=_NUM_ITERATIONS, motion=motion)
        one[rows[:num_placed]] @= np.asarray(motions, np.float64)[:num_placed]
    return T

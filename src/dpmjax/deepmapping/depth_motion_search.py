"""The motions by which a depth image may follow earlier ones: a search of the largest projective consistency.

It goes from coarse to fine, first against the last images, then against more. Images of walls hardly tell how far a
camera has moved along them: the best motions that differ are slid along the surfaces of the image, and contradictions
decide.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.deepmapping.config import Motion
from dpmjax.deepmapping.depth_config import DepthInitializationConfig
from dpmjax.deepmapping.projective_consistency import (
    Agreement,
    DepthScans,
    Pinhole,
    PixelSample,
    both_ways,
)
from dpmjax.deepmapping.spatial import motion_matrices
from dpmjax.geometry import rigid
from dpmjax.geometry.normals import image_normals

# Motions differ by such shares of the largest translation and turn: those that are slid, and those that are kept then.
_DIFFERENT, _SLID_APART = (0.35, 0.1), (0.08, 0.04)
# Motions are slid so many largest translations far, and may then be so long.
_SLIDE, _LONGEST = 1.4, 1.5
# Widths of variations in shares of the limits: in the first round, and after the slides; halved from round to round.
_FIRST_SPREAD, _SLID_SPREAD = 0.25, 0.04


class Views(NamedTuple):
    """Images as the search sees them; of one image without the leading axis.

    Attributes:
        sample: (r, p, 3) points of each.
        surfaces: (r, 4, h - 1, w - 1) their surfaces, as `image_surface` has them.
        directions: (r, a, 3) axes of the surfaces in the camera frame, that along which the surfaces hold least first.
    """

    sample: PixelSample
    surfaces: Float[Array, "... 4 r c"]
    directions: Float[Array, "... a 3"]


class References(NamedTuple):
    """Earlier images that an image is compared to, the last one first.

    Attributes:
        T_last_reference: poses in the frame of the last image.
        weights: 0 for images that are not there.
        views: the images.
    """

    T_last_reference: Float[Array, "r 4 4"]
    weights: Float[Array, " r"]
    views: Views


def surface_directions(scans: DepthScans, motion: Motion) -> NDArray[np.float32]:
    """Directions in which the surfaces of an image hold the camera, from the least to the most.

    Args:
        scans: depth images.
        motion: "planar": two axes in the plane x, z; "full": three.

    Returns:
        (n, a, 3) principal axes of the normals, in the camera frames.
    """
    normals, _ = image_normals(np.asarray(scans.points), np.asarray(scans.mask))
    axes = [0, 2] if motion == "planar" else [0, 1, 2]
    spread = np.einsum("nhwi,nhwj->nij", normals[..., axes], normals[..., axes])
    directions = np.zeros((len(normals), len(axes), 3), np.float32)
    directions[..., axes] = np.swapaxes(np.linalg.eigh(spread)[1], -1, -2)
    return directions


def propose_motions(
    T_world_camera: NDArray[np.float64],
    views: Views,
    pinhole: Pinhole,
    config: DepthInitializationConfig,
    motion: Motion,
    *,
    key: jax.Array,
) -> NDArray[np.float64]:
    """The best motions of the next image that differ.

    Args:
        T_world_camera: (m, 4, 4) poses of the images before it.
        views: all images, n > m.
        pinhole: of the camera.
        config: of the search.
        motion: "planar" or "full".
        key: of the search.

    Returns:
        (k, 4, 4) T_last_next, the best one first.
    """
    scan, num_scans = len(T_world_camera), views.surfaces.shape[0]
    num_checked = min(max(config.num_references, config.num_checked), num_scans - 1)
    # A window of fixed length: where there are fewer images before, the first is repeated without weight.
    before = scan - 1 - np.arange(num_checked)
    rows = np.maximum(before, 0)
    references = References(
        jnp.asarray(np.linalg.inv(T_world_camera[-1]) @ T_world_camera[rows], jnp.float32),
        jnp.asarray(before >= 0, jnp.float32),
        _take(views, rows),
    )
    found = _search(references, _take(views, scan), pinhole, key, config=config, motion=motion)
    return np.asarray(found, np.float64)


def motion_cost(length: Any, turn: Any, config: DepthInitializationConfig) -> Any:
    """What motions cost, in consistency: the shortest one is taken where images leave it open.

    Args:
        length: of motions between neighbouring images, unit of the points.
        turn: their angles, radians.
        config: of the search.

    Returns:
        The cost of each.
    """
    turn_share = turn / np.deg2rad(config.max_turn_deg)
    return config.translation_weight * length / config.max_translation + config.turn_weight * turn_share


def _take(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def _turn_of(T: Float[Array, "... 4 4"]) -> Float[Array, "..."]:
    """Angle of a motion, radians."""
    return jnp.arccos(jnp.clip(0.5 * (jnp.trace(T[..., :3, :3], axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))


def _score_motion(
    T_last_scan: Float[Array, "4 4"],
    references: References,
    view: Views,
    pinhole: Pinhole,
    tolerance: Array,
    config: DepthInitializationConfig,
) -> Float[Array, ""]:
    """Consistency of an image with its references at a motion, less the cost of the motion."""

    def against(T_last_ref: Array, reference: Views) -> Agreement:
        T_ref_scan = jnp.matmul(rigid.inverse(T_last_ref), T_last_scan, precision=jax.lax.Precision.HIGHEST)
        samples, surfaces = (view.sample, reference.sample), (view.surfaces, reference.surfaces)
        return both_ways(T_ref_scan, samples, surfaces, pinhole, tolerance)

    agreements = jax.vmap(against)(references.T_last_reference, references.views)
    agreement = Agreement(*(references.weights * values for values in agreements))
    length = jnp.linalg.norm(T_last_scan[:3, 3])
    score = agreement.consistency() - motion_cost(length, _turn_of(T_last_scan), config)
    return jnp.where(length > _LONGEST * config.max_translation, -jnp.inf, score)


def _distinct(
    T: Float[Array, "m 4 4"], scores: Float[Array, " m"], shares: tuple[float, float], config: DepthInitializationConfig
) -> Float[Array, "k 4 4"]:
    """The best motions that differ by these shares of the largest translation or turn from all better ones."""
    far, turn = shares[0] * config.max_translation, shares[1] * np.deg2rad(config.max_turn_deg)

    def pick(left: Float[Array, " m"], _: None) -> tuple[Float[Array, " m"], Array]:
        best = T[jnp.argmax(left)]
        turned = _turn_of(jnp.matmul(rigid.inverse(best), T, precision=jax.lax.Precision.HIGHEST))
        is_near = (jnp.linalg.norm(T[:, :3, 3] - best[:3, 3], axis=-1) < far) & (turned < turn)
        return jnp.where(is_near, -jnp.inf, left), best

    return jax.lax.scan(pick, scores, length=config.num_distinct)[1]


def _slid(
    T: Float[Array, "k 4 4"], directions: Float[Array, "a 3"], config: DepthInitializationConfig
) -> Float[Array, "m 4 4"]:
    """The motions, each moved to and fro along each axis of the image."""
    lengths = _SLIDE * config.max_translation * jnp.linspace(-1.0, 1.0, config.num_slides)
    moves = (lengths[:, None, None] * directions).reshape(-1, 3)
    T_scan_slid = jnp.tile(jnp.eye(4), (len(moves), 1, 1)).at[:, :3, 3].set(moves)
    slid = jnp.matmul(T[:, None], T_scan_slid, precision=jax.lax.Precision.HIGHEST).reshape(-1, 4, 4)
    return jnp.concatenate([T, slid])


@partial(jax.jit, static_argnames=("config", "motion"))
def _search(
    references: References,
    view: Views,
    pinhole: Pinhole,
    key: jax.Array,
    *,
    config: DepthInitializationConfig,
    motion: Motion,
) -> Float[Array, "k 4 4"]:
    """The best T_last_scan of the image that differ."""
    turn, tilt, far = np.deg2rad(config.max_turn_deg), np.deg2rad(config.max_tilt_deg), config.max_translation
    widths = jnp.array([far, far, turn] if motion == "planar" else [far, far, far, tilt, turn, tilt])
    first_key, round_key = jax.random.split(key)
    values = widths * jax.random.uniform(first_key, (config.num_candidates, len(widths)), minval=-1.0, maxval=1.0)
    T = motion_matrices(values.at[0].set(0.0))
    first, last = np.log(config.tolerance[0]), np.log(config.tolerance[1])
    slides_at = config.num_rounds // 2
    nearest = _take(references, slice(config.num_references))
    for step in range(config.num_rounds):
        tolerance = jnp.exp(first + (last - first) * step / max(config.num_rounds - 1, 1))
        compared = nearest if step < slides_at else references

        def score(T_last_scan: Array, tolerance: Array = tolerance, compared: References = compared) -> Array:
            return _score_motion(T_last_scan, compared, view, pinhole, tolerance, config)

        scores = jax.lax.map(score, T, batch_size=128)
        if step == slides_at - 1:
            T = _slid(_distinct(T, scores, _DIFFERENT, config), view.directions, config)
            continue
        if step < slides_at:
            best, spread = T[jax.lax.top_k(scores, config.num_kept)[1]], _FIRST_SPREAD * 0.5**step
        else:
            best, spread = _distinct(T, scores, _SLID_APART, config), _SLID_SPREAD * 0.5 ** (step - slides_at)
        noise = jax.random.normal(jax.random.fold_in(round_key, step), (config.num_varied, len(best), len(widths)))
        # The kept motions themselves are candidates of the next round.
        moves = motion_matrices((spread * widths * noise.at[0].set(0.0)).reshape(-1, len(widths)))
        moves = moves.reshape(config.num_varied, len(best), 4, 4)
        T = jnp.matmul(best, moves, precision=jax.lax.Precision.HIGHEST).reshape(-1, 4, 4)
    return best

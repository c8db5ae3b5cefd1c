"""First poses of depth images without a guess: each image is registered to the images before it by a search.

The search over motions maximises the projective consistency, coarse to fine, first with the last images, then with all
earlier ones. Images of walls hardly tell how far a camera has moved along them: the best motions that differ are slid
along the surfaces of the image, and contradictions decide. The search is repeated with other samples, and the
trajectory of the largest projective consistency of all images is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.deepmapping.config import Motion
from dpmjax.deepmapping.projective_consistency import (
    Agreement,
    DepthScans,
    Pinhole,
    PixelSample,
    both_ways,
    projective_consistency,
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


@dataclass(frozen=True)
class DepthInitializationConfig:
    """Settings of the search. Lengths are in the unit of the points, metres by default.

    Attributes:
        max_translation: between neighbouring images, along each axis.
        max_turn_deg: between neighbouring images, about the vertical axis of the camera.
        max_tilt_deg: about the other axes; full motion only.
        num_tries: trajectories, each with other samples; that of the largest projective consistency is kept.
        num_candidates: motions of the first round, spread evenly.
        num_kept: best motions that go on to the next round, before the slides.
        num_distinct: motions that are slid, and that go on to the next round after it.
        num_slides: places of each along each direction of the surfaces.
        num_varied: new motions around each kept one in a round.
        num_rounds: each round varies the kept motions half as widely as the round before; half of them are before the
            slides.
        num_references: number of earlier images that an image is compared to before the slides.
        num_checked: number of earlier images that an image is compared to from the slides on.
        num_points: of each image.
        tolerance: share of the depth by which matching points may differ, in the first and in the last round.
        translation_weight: cost of the largest translation, in consistency. Along a bare wall nothing
            else tells how far the camera has moved, and then the shortest move is taken.
        turn_weight: cost of the largest turn, likewise.
    """

    max_translation: float = 0.7
    max_turn_deg: float = 75.0
    max_tilt_deg: float = 30.0
    num_tries: int = 8
    num_candidates: int = 1024
    num_kept: int = 32
    num_distinct: int = 8
    num_slides: int = 51
    num_varied: int = 20
    num_rounds: int = 8
    num_references: int = 4
    num_checked: int = 8
    num_points: int = 100
    tolerance: tuple[float, float] = (0.12, 0.02)
    translation_weight: float = 0.05
    turn_weight: float = 0.0

    def __post_init__(self) -> None:
        counts = (self.num_tries, self.num_candidates, self.num_kept, self.num_varied, self.num_rounds)
        more = (self.num_distinct, self.num_slides, self.num_references, self.num_checked, self.num_points)
        if min(*counts, *more) < 1:
            raise ValueError(f"all counts must be at least 1, got {self}")


PLANAR_SEARCH = DepthInitializationConfig()
"""A level camera on wheels."""

FULL_SEARCH = DepthInitializationConfig(
    num_tries=4,
    num_candidates=16384,
    num_varied=48,
    tolerance=(0.12, 0.03),
    translation_weight=0.2,
    turn_weight=0.3,
)
"""A hand-held camera: six numbers to search instead of three, small moves between images, a real sensor's noise."""


class _Views(NamedTuple):
    """Images as the search sees them; of one image without the leading axis.

    Attributes:
        sample: (r, p, 3) points of each.
        depth: (r, h, w) depth images.
        directions: (r, a, 3) axes of the surfaces in the camera frame, that along which the surfaces hold least first.
    """

    sample: PixelSample
    depth: Float[Array, "... h w"]
    directions: Float[Array, "... a 3"]


class _References(NamedTuple):
    """Earlier images that an image is compared to, the last one first.

    Attributes:
        T_last_reference: poses in the frame of the last image.
        weights: 0 for images that are not there.
        views: the images.
    """

    T_last_reference: Float[Array, "r 4 4"]
    weights: Float[Array, " r"]
    views: _Views


def initialize_depth(
    scans: DepthScans, config: DepthInitializationConfig | None = None, *, motion: Motion = "planar", key: jax.Array
) -> NDArray[np.float64]:
    """First poses of all images, the first at the origin.

    Args:
        scans: in order of time; neighbours overlap.
        config: of the search; None: `PLANAR_SEARCH` or `FULL_SEARCH`, by the motion.
        motion: "planar" or "full".
        key: of the search.

    Returns:
        (n, 4, 4) T_world_camera, unit of the points.
    """
    config = config or (PLANAR_SEARCH if motion == "planar" else FULL_SEARCH)
    directions = surface_directions(scans, motion)
    tries = [
        _chain_images(scans, directions, config, motion, key=jax.random.fold_in(key, k))
        for k in range(config.num_tries)
    ]

    def score(T: NDArray[np.float64]) -> float:
        moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=-1).mean() / config.max_translation
        return float(projective_consistency(scans, T) - config.translation_weight * moved)

    return max(tries, key=score)


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


def _chain_images(
    scans: DepthScans,
    directions: NDArray[np.float32],
    config: DepthInitializationConfig,
    motion: Motion,
    *,
    key: jax.Array,
) -> NDArray[np.float64]:
    """One trajectory, image after image."""
    num_scans = scans.mask.shape[0]
    points, mask, depth = np.asarray(scans.points), np.asarray(scans.mask), scans.depth
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    chosen = [rng.choice(np.flatnonzero(m), config.num_points) for m in mask.reshape(num_scans, -1)]
    some = jnp.asarray(np.stack([p[c] for p, c in zip(points.reshape(num_scans, -1, 3), chosen, strict=True)]))
    views = _Views(PixelSample(some, jnp.ones(some.shape[:2], bool)), depth, jnp.asarray(directions))
    T = [np.eye(4)]
    num_checked = min(max(config.num_references, config.num_checked), num_scans - 1)
    for scan in range(1, num_scans):
        # A window of fixed length: where there are fewer images before, the first is repeated without weight.
        rows = np.maximum(scan - 1 - np.arange(num_checked), 0)
        references = _References(
            jnp.asarray(np.linalg.inv(T[-1]) @ np.stack([T[row] for row in rows]), jnp.float32),
            jnp.asarray(scan - 1 - np.arange(num_checked) >= 0, jnp.float32),
            _take(views, rows),
        )
        search_key = jax.random.fold_in(key, scan)
        T_last_scan = _search(references, _take(views, scan), scans.pinhole, search_key, config=config, motion=motion)
        T.append(T[-1] @ np.asarray(T_last_scan, np.float64))
    return np.stack(T)


def _take(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def _turn_of(T: Float[Array, "... 4 4"]) -> Float[Array, "..."]:
    """Angle of a motion, radians."""
    return jnp.arccos(jnp.clip(0.5 * (jnp.trace(T[..., :3, :3], axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))


def _score_motion(
    T_last_scan: Float[Array, "4 4"],
    references: _References,
    view: _Views,
    pinhole: Pinhole,
    tolerance: Array,
    config: DepthInitializationConfig,
) -> Float[Array, ""]:
    """Consistency of an image with its references at a motion, less the cost of the motion."""

    def against(T_last_ref: Array, reference: _Views) -> Agreement:
        T_ref_scan = jnp.matmul(rigid.inverse(T_last_ref), T_last_scan, precision=jax.lax.Precision.HIGHEST)
        samples, depths = (view.sample, reference.sample), (view.depth, reference.depth)
        return both_ways(T_ref_scan, samples, depths, pinhole, tolerance)

    agreements = jax.vmap(against)(references.T_last_reference, references.views)
    agreement = Agreement(*(references.weights * values for values in agreements))
    length = jnp.linalg.norm(T_last_scan[:3, 3]) / config.max_translation
    turned = _turn_of(T_last_scan) / np.deg2rad(config.max_turn_deg)
    cost = config.translation_weight * length + config.turn_weight * turned
    return jnp.where(length > _LONGEST, -jnp.inf, agreement.consistency() - cost)


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
    references: _References,
    view: _Views,
    pinhole: Pinhole,
    key: jax.Array,
    *,
    config: DepthInitializationConfig,
    motion: Motion,
) -> Float[Array, "4 4"]:
    """T_last_scan of the image."""
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

        def score(T_last_scan: Array, tolerance: Array = tolerance, compared: _References = compared) -> Array:
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
    return best[0]

"""First poses of depth images without a guess: each image is registered to the images before it by a search.

The search over motions maximises the projective consistency with the last images together, coarse to fine. It is
repeated with other samples, and the trajectory of the largest projective consistency of all images is kept.
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
    DepthScans,
    Pinhole,
    PixelSample,
    both_ways,
    projective_consistency,
)
from dpmjax.deepmapping.spatial import motion_matrices
from dpmjax.geometry import rigid


@dataclass(frozen=True)
class DepthInitializationConfig:
    """Settings of the search. Lengths are in the unit of the points, metres by default.

    Attributes:
        max_translation: between neighbouring images, along each axis.
        max_turn_deg: between neighbouring images, about the vertical axis of the camera.
        max_tilt_deg: about the other axes; full motion only.
        num_tries: trajectories, each with other samples; that of the largest projective consistency is kept.
        num_candidates: motions of the first round, spread evenly.
        num_kept: best motions that go on to the next round.
        num_varied: new motions around each kept one in a round.
        num_rounds: each round varies the kept motions half as widely as the round before.
        num_references: number of earlier images that an image is compared to.
        num_points: of each image.
        tolerance: share of the depth by which matching points may differ, in the first and in the last round.
        translation_weight: cost of the largest translation, in consistency with one image. Along a bare wall nothing
            else tells how far the camera has moved, and then the shortest move is taken.
        turn_weight: cost of the largest turn, likewise.
    """

    max_translation: float = 0.7
    max_turn_deg: float = 75.0
    max_tilt_deg: float = 30.0
    num_tries: int = 2
    num_candidates: int = 2048
    num_kept: int = 16
    num_varied: int = 24
    num_rounds: int = 7
    num_references: int = 4
    num_points: int = 100
    tolerance: tuple[float, float] = (0.12, 0.01)
    translation_weight: float = 0.1
    turn_weight: float = 0.0

    def __post_init__(self) -> None:
        counts = (self.num_tries, self.num_candidates, self.num_kept, self.num_varied, self.num_rounds)
        if min(*counts, self.num_references, self.num_points) < 1:
            raise ValueError(f"all counts must be at least 1, got {self}")


PLANAR_SEARCH = DepthInitializationConfig()
"""A level camera on wheels."""

FULL_SEARCH = DepthInitializationConfig(
    num_candidates=16384, num_kept=32, num_varied=48, tolerance=(0.12, 0.03), translation_weight=0.2, turn_weight=0.3
)
"""A hand-held camera: six numbers to search instead of three, small moves between images, a real sensor's noise."""


class _Views(NamedTuple):
    """Images as the search sees them; of one image without the leading axis.

    Attributes:
        sample: (r, p, 3) points of each.
        depth: (r, h, w) depth images.
    """

    sample: PixelSample
    depth: Float[Array, "... h w"]


class _References(NamedTuple):
    """Earlier images that an image is compared to.

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
    tries = [_chain_images(scans, config, motion, key=jax.random.fold_in(key, k)) for k in range(config.num_tries)]

    def score(T: NDArray[np.float64]) -> float:
        moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=-1).mean() / config.max_translation
        return float(projective_consistency(scans, T) - config.translation_weight * moved)

    return max(tries, key=score)


def _chain_images(
    scans: DepthScans, config: DepthInitializationConfig, motion: Motion, *, key: jax.Array
) -> NDArray[np.float64]:
    """One trajectory, image after image."""
    num_scans = scans.mask.shape[0]
    points, mask, depth = np.asarray(scans.points), np.asarray(scans.mask), scans.depth
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    chosen = [rng.choice(np.flatnonzero(m), config.num_points) for m in mask.reshape(num_scans, -1)]
    some = jnp.asarray(np.stack([p[c] for p, c in zip(points.reshape(num_scans, -1, 3), chosen, strict=True)]))
    views = _Views(PixelSample(some, jnp.ones(some.shape[:2], bool)), depth)
    T = [np.eye(4)]
    for scan in range(1, num_scans):
        # A window of fixed length: where there are fewer images before, the last is repeated without weight.
        rows = np.maximum(scan - 1 - np.arange(config.num_references), 0)
        references = _References(
            jnp.asarray(np.linalg.inv(T[-1]) @ np.stack([T[row] for row in rows]), jnp.float32),
            jnp.asarray(scan - 1 - np.arange(config.num_references) >= 0, jnp.float32),
            _take(views, rows),
        )
        search_key = jax.random.fold_in(key, scan)
        T_last_scan = _search(references, _take(views, scan), scans.pinhole, search_key, config=config, motion=motion)
        T.append(T[-1] @ np.asarray(T_last_scan, np.float64))
    return np.stack(T)


def _take(views: _Views, rows: Any) -> _Views:
    return jax.tree.map(lambda leaf: leaf[rows], views)


def _score_motion(
    T_last_scan: Float[Array, "4 4"],
    references: _References,
    view: _Views,
    pinhole: Pinhole,
    tolerance: Array,
    config: DepthInitializationConfig,
) -> Float[Array, ""]:
    """Consistency of an image with its references at a motion, less the cost of the motion."""

    def against(T_last_ref: Array, reference: _Views) -> Array:
        T_ref_scan = jnp.matmul(rigid.inverse(T_last_ref), T_last_scan, precision=jax.lax.Precision.HIGHEST)
        samples, depths = (view.sample, reference.sample), (view.depth, reference.depth)
        return both_ways(T_ref_scan, samples, depths, pinhole, tolerance)

    scores = jax.vmap(against)(references.T_last_reference, references.views)
    cost = config.translation_weight * jnp.linalg.norm(T_last_scan[:3, 3]) / config.max_translation
    turned = jnp.arccos(jnp.clip(0.5 * (jnp.trace(T_last_scan[:3, :3]) - 1.0), -1.0, 1.0))
    cost += config.turn_weight * turned / np.deg2rad(config.max_turn_deg)
    return jnp.sum(references.weights * (scores - cost))


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
    values = values.at[0].set(0.0)
    first, last = np.log(config.tolerance[0]), np.log(config.tolerance[1])
    for step in range(config.num_rounds):
        tolerance = jnp.exp(first + (last - first) * step / max(config.num_rounds - 1, 1))

        def score(motion_values: Float[Array, " k"], tolerance: Array = tolerance) -> Array:
            T_last_scan = motion_matrices(motion_values[None])[0]
            return _score_motion(T_last_scan, references, view, pinhole, tolerance, config)

        best = values[jax.lax.top_k(jax.lax.map(score, values, batch_size=256), config.num_kept)[1]]
        noise = jax.random.normal(jax.random.fold_in(round_key, step), (config.num_varied, *best.shape))
        spread = 0.25 * widths * 0.5**step
        # The kept motions themselves are candidates of the next round.
        values = (best + spread * noise.at[0].set(0.0)).reshape(-1, len(widths))
    return motion_matrices(best[:1])[0]

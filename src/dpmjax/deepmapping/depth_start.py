"""A start for depth images without any first guess: one image after the other is placed where it contradicts the
images before it least.

A search over motions maximises agreements less contradictions against the last images together, coarse to fine. It is
done several times over with other samples, and the walk of which all images agree best is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.deepmapping.depth_agreement import agreement, mean_agreement
from dpmjax.deepmapping.depth_config import Motion
from dpmjax.deepmapping.depth_scans import DepthScans, Pinhole, motion_matrices
from dpmjax.geometry import rigid


@dataclass(frozen=True)
class DepthStartConfig:
    """Settings of the search. Lengths are in the unit of the points, metres by default.

    Attributes:
        max_translation: between neighbouring images, along each axis.
        max_turn_deg: between neighbouring images, about the vertical axis of the camera.
        max_tilt_deg: about the other axes; full motion only.
        num_tries: walks that are placed, each with other samples; that of which all images agree best is kept.
        num_candidates: motions that are tried at first, spread evenly.
        num_kept: best ones that go on to the next round.
        num_varied: new motions around each kept one in a round.
        num_rounds: each kept motion is varied, half as widely as in the round before.
        num_references: images before that are compared to.
        num_points: of each image.
        tolerance: share of the depth by which agreeing points may differ, in the first and in the last round.
        rest_weight: what the largest translation costs, in agreement with one image: along a bare wall nothing else
            tells how far the camera has moved, and then the shortest move is taken.
        turn_weight: what the largest turn costs, likewise.
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
    rest_weight: float = 0.1
    turn_weight: float = 0.0

    def __post_init__(self) -> None:
        counts = (self.num_tries, self.num_candidates, self.num_kept, self.num_varied, self.num_rounds)
        if min(*counts, self.num_references, self.num_points) < 1:
            raise ValueError(f"all counts must be at least 1, got {self}")


PLANAR_START = DepthStartConfig()
"""A level camera on wheels."""

FULL_START = DepthStartConfig(
    num_candidates=16384,
    num_kept=32,
    num_varied=48,
    tolerance=(0.12, 0.03),
    rest_weight=0.2,
    turn_weight=0.3,
)
"""A hand-held camera: six numbers to search instead of three, small moves between images, a real sensor's noise."""


def place_images(
    scans: DepthScans, config: DepthStartConfig | None = None, *, motion: Motion = "planar", key: jax.Array
) -> NDArray[np.float64]:
    """Poses of all images, the first at the origin.

    Args:
        scans: in order of time; neighbours overlap.
        config: of the search; None: `PLANAR_START` or `FULL_START`, by the motion.
        motion: "planar" or "full".
        key: of the search.

    Returns:
        (n, 4, 4) T_world_camera, unit of the points.
    """
    config = config or (PLANAR_START if motion == "planar" else FULL_START)
    tries = [_place(scans, config, motion, key=jax.random.fold_in(key, k)) for k in range(config.num_tries)]

    def score(T: NDArray[np.float64]) -> float:
        rest = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=-1).mean() / config.max_translation
        return float(mean_agreement(scans, jnp.asarray(T, jnp.float32))) - config.rest_weight * float(rest)

    return max(tries, key=score)


def _place(scans: DepthScans, config: DepthStartConfig, motion: Motion, *, key: jax.Array) -> NDArray[np.float64]:
    """One walk, image after image."""
    num_scans = scans.mask.shape[0]
    points, mask, depth = np.asarray(scans.points), np.asarray(scans.mask), scans.depth
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    chosen = [rng.choice(np.flatnonzero(m), config.num_points) for m in mask.reshape(num_scans, -1)]
    some = jnp.asarray(np.stack([p[c] for p, c in zip(points.reshape(num_scans, -1, 3), chosen, strict=True)]))
    T = [np.eye(4)]
    for scan in range(1, num_scans):
        # A window of fixed length: where there are fewer images before, the last is repeated without weight.
        rows = np.maximum(scan - 1 - np.arange(config.num_references), 0)
        weights = (scan - 1 - np.arange(config.num_references) >= 0).astype(np.float32)
        T_last_reference = np.linalg.inv(T[-1]) @ np.stack([T[row] for row in rows])
        T_last_scan = _search(
            jnp.asarray(T_last_reference, jnp.float32),
            jnp.asarray(weights),
            some[rows],
            depth[rows],
            some[scan],
            depth[scan],
            scans.pinhole,
            jax.random.fold_in(key, scan),
            config=config,
            motion=motion,
        )
        T.append(T[-1] @ np.asarray(T_last_scan, np.float64))
    return np.stack(T)


@partial(jax.jit, static_argnames=("config", "motion"))
def _search(
    T_last_reference: Float[Array, "r 4 4"],
    weights: Float[Array, " r"],
    reference_points: Float[Array, "r p 3"],
    reference_depth: Float[Array, "r h w"],
    points: Float[Array, "p 3"],
    depth: Float[Array, "h w"],
    pinhole: Pinhole,
    key: jax.Array,
    *,
    config: DepthStartConfig,
    motion: Motion,
) -> Float[Array, "4 4"]:
    """T_last_scan of the image."""
    everywhere = jnp.ones(points.shape[0], bool)

    def score(values: Float[Array, " k"], tolerance: Array) -> Array:
        T_last_scan = motion_matrices(values[None])[0]

        def against(T_last_ref: Array, ref_points: Array, ref_depth: Array) -> Array:
            T_ref_scan = jnp.matmul(rigid.inverse(T_last_ref), T_last_scan, precision=jax.lax.Precision.HIGHEST)
            there = agreement(T_ref_scan, points, everywhere, ref_depth, pinhole, tolerance)
            back = agreement(rigid.inverse(T_ref_scan), ref_points, everywhere, depth, pinhole, tolerance)
            return there + back

        scores = jax.vmap(against)(T_last_reference, reference_points, reference_depth)
        rest = config.rest_weight * jnp.linalg.norm(T_last_scan[:3, 3]) / config.max_translation
        turned = jnp.arccos(jnp.clip(0.5 * (jnp.trace(T_last_scan[:3, :3]) - 1.0), -1.0, 1.0))
        rest += config.turn_weight * turned / np.deg2rad(config.max_turn_deg)
        return jnp.sum(weights * (scores - 2.0 * rest))

    turn, tilt = np.deg2rad(config.max_turn_deg), np.deg2rad(config.max_tilt_deg)
    reach = config.max_translation
    widths = jnp.array([reach, reach, turn] if motion == "planar" else [reach, reach, reach, tilt, turn, tilt])
    first_key, round_key = jax.random.split(key)
    values = widths * jax.random.uniform(first_key, (config.num_candidates, len(widths)), minval=-1.0, maxval=1.0)
    values = values.at[0].set(0.0)
    first, last = np.log(config.tolerance[0]), np.log(config.tolerance[1])
    for step in range(config.num_rounds):
        tolerance = jnp.exp(first + (last - first) * step / max(config.num_rounds - 1, 1))
        scores = jax.lax.map(partial(score, tolerance=tolerance), values, batch_size=256)
        best = values[jax.lax.top_k(scores, config.num_kept)[1]]
        if step + 1 == config.num_rounds:
            return motion_matrices(best[:1])[0]
        noise = jax.random.normal(jax.random.fold_in(round_key, step), (config.num_varied, *best.shape))
        spread = 0.25 * widths * 0.5**step
        # The kept ones themselves stay in the race.
        values = (best + spread * noise.at[0].set(0.0)).reshape(-1, len(widths))
    raise AssertionError

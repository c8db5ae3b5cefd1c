"""Search of the motions of a depth image relative to earlier images by projective consistency.

Motions are drawn and varied from coarse to fine against the last images. An image of a wall hardly constrains the
motion along the wall, so distinct best motions are also shifted along the surfaces of the image. The best of these are
adjusted against more images. Many distinct motions are proposed, so that later images resolve the ambiguity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import Motion
from dpmjax.kept_programs import kept_jit
from dpmjax.scan.apart import apart
from dpmjax.scan.depth.align import (
    NUM_POINTS,
    DepthCamera,
    DepthImages,
    DepthView,
    adjust_poses,
    group_consistency,
    linearise_images,
    step_poses,
)
from dpmjax.scan.depth.compare import Agreement, both_ways
from dpmjax.scan.depth.record import Pinhole, PixelSample, Views
from dpmjax.scan.depth.slide import slide_motions
from dpmjax.types import AnyArray

# Largest translation between neighbouring images along each axis, metres.
MAX_TRANSLATION = 0.7
# Largest turn between neighbouring images about the vertical axis of the camera, and largest tilt (turn about a
# horizontal axis; full motion only), degrees.
MAX_TURN_DEG, _MAX_TILT_DEG = 75.0, 30.0
# Number of best motions that are kept for the next round. Number of distinct adjusted motions that are proposed; for an
# unconstrained direction along a wall they are spread along the wall.
_NUM_KEPT, _NUM_DISTINCT = 32, 16
# Number of rounds of motions, each with half the variation of the one before.
_NUM_ROUNDS = 4
# Number of distinct best motions of the last round that are shifted; number of shifts along each direction of the
# surfaces; number of distinct best motions after the shifts that are adjusted.
_NUM_SLID, _NUM_SLIDES, _NUM_ADJUSTED = 8, 51, 32
# Number of earlier images that an image is compared with and adjusted to, and compared with after the shifts.
_NUM_REFERENCES, NUM_CHECKED = 4, 8
# Least differences of distinct motions, as shares of the largest translation and turn: before the shifts, and after.
_DIFFERENT, _SLID_APART = (0.35, 0.1), (0.12, 0.06)
# Largest shift, and longest motion after a shift, in largest translations.
_SLIDE, _LONGEST = 1.4, 1.5
# Number of tolerances of an adjustment, and of steps at each.
_NUM_TOLERANCES, _NUM_ITERATIONS = 4, 2
# Motions that are scored by one call of the program.
_NUM_SCORED = 1024

Poses = Float[np.ndarray, "_ 4 4"]


class SearchConfig(NamedTuple):
    """Settings of the search, which depend on the degrees of freedom of the camera.

    Attributes:
        tolerance: tolerance of matching points as a share of the depth, in the first and in the last round; the last
            one is also that of incomplete trajectories.
        final_tolerance: tolerance of the last adjustment and of the choice of the best trajectory.
        translation_weight: cost of the largest translation, in units of consistency. Along a bare wall, where the
            translation is unconstrained, this cost selects the shortest one.
        turn_weight: cost of the largest turn, in units of consistency.
        num_trajectories: largest number of trajectories that are kept from image to image.
        num_candidates: number of motions of the first round, spread evenly.
        num_varied: number of new motions around each kept one in a round.
    """

    tolerance: tuple[float, float]
    final_tolerance: float
    translation_weight: float
    turn_weight: float
    num_trajectories: int
    num_candidates: int
    num_varied: int

    @property
    def tolerances(self) -> Float[np.ndarray, " t"]:
        """Tolerances of the rounds, then those of the adjustment."""
        return np.geomspace(*self.tolerance, _NUM_ROUNDS + _NUM_TOLERANCES)


# Images of a hand-held camera have the noise of a real sensor, and small motions between them: wider tolerances, and
# higher costs of motions.
SEARCH: dict[Motion, SearchConfig] = {
    "planar": SearchConfig((0.12, 0.02), 0.006, 0.05, 0.0, num_trajectories=16, num_candidates=1024, num_varied=20),
    "full": SearchConfig((0.12, 0.03), 0.015, 0.2, 0.3, num_trajectories=8, num_candidates=16384, num_varied=48),
}


def propose_motions(
    T_world_camera: Poses, before: Sequence[DepthView], view: DepthView, camera: DepthCamera, rng: np.random.Generator
) -> Poses:
    """Searches the best distinct motions of the next image.

    Args:
        T_world_camera: (m, 4, 4) poses of the images before the next one.
        before: their views.
        view: the next image.
        camera: camera of the images.
        rng: draws motions and samples of points.

    Returns:
        (k, 4, 4) T_last_next, the best one first.
    """
    config, num_checked = SEARCH[camera.motion], min(NUM_CHECKED, len(before))
    # The last image first.
    references = list(before[-num_checked:])[::-1]
    T_last_reference = (rigid.inverse(T_world_camera[-1]) @ T_world_camera[-num_checked:])[::-1]
    search = _Search(references, T_last_reference, view, camera, int(rng.integers(1 << 16)))
    axes, far = camera.axes, MAX_TRANSLATION
    turn, tilt = np.deg2rad(MAX_TURN_DEG), np.deg2rad(_MAX_TILT_DEG)
    widths = np.zeros(6)
    widths[axes] = np.array([far, far, far, tilt, turn, tilt])[axes]
    steps = widths * rng.uniform(-1.0, 1.0, (config.num_candidates, 6))
    steps[0] = 0.0
    T = _motions(steps)
    if len(T) > 2 * _NUM_SCORED:
        # Few points sort out most of many motions.
        screen = search._replace(num_points=NUM_POINTS // 4).scores(T, config.tolerances[0], _NUM_REFERENCES)
        T = T[np.argsort(-screen)[: 2 * _NUM_SCORED]]
    for step in range(_NUM_ROUNDS - 1):
        best = T[np.argsort(-search.scores(T, config.tolerances[step], _NUM_REFERENCES))[:_NUM_KEPT]]
        noise = rng.standard_normal((config.num_varied, len(best), 6))
        noise[0] = 0.0  # The kept motions themselves are candidates of the next round.
        # Width of the first variations as a share of the limits; halved from round to round.
        moves = _motions((0.25 * 0.5**step * widths * noise).reshape(-1, 6))
        T = (best @ moves.reshape(config.num_varied, len(best), 4, 4)).reshape(-1, 4, 4)
    scores = search.scores(T, config.tolerances[_NUM_ROUNDS - 1], _NUM_REFERENCES)
    lengths = _SLIDE * MAX_TRANSLATION * np.linspace(-1.0, 1.0, _NUM_SLIDES)
    T = slide_motions(motions_apart(T, scores, _NUM_SLID, _DIFFERENT), view.directions, lengths)
    scores = search.scores(T, config.tolerances[_NUM_ROUNDS], NUM_CHECKED)
    T = motions_apart(T, scores, _NUM_ADJUSTED, _SLID_APART)
    T, scores = search.adjusted(T, config.tolerances[_NUM_ROUNDS:])
    return motions_apart(T, scores, _NUM_DISTINCT, _SLID_APART)


def motion_cost(T_before_after: Float[np.ndarray, "*m 4 4"], motion: Motion) -> Float[np.ndarray, "*m"]:
    """Computes a regulariser of camera motions that is linear in translation and turn, in units of consistency.

    Args:
        T_before_after: motions between neighbouring images.
        motion: degrees of freedom of the camera.

    Returns:
        The cost of each motion.
    """
    config, length = SEARCH[motion], np.linalg.norm(T_before_after[..., :3, 3], axis=-1)
    turn_share = turns_rad(T_before_after) / np.deg2rad(MAX_TURN_DEG)
    return np.asarray(config.translation_weight * length / MAX_TRANSLATION + config.turn_weight * turn_share)


def turns_rad(T: Float[np.ndarray, "*m 4 4"]) -> Float[np.ndarray, "*m"]:
    """Returns the angles of motions, radians."""
    return np.asarray(Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).magnitude()).reshape(T.shape[:-2])


def _motions(steps: Float[np.ndarray, "m 6"]) -> Poses:
    return step_poses(np.eye(4), steps)


class _References(NamedTuple):
    # Four earlier images: their poses in the frame of the last one, points, surfaces; those with weight 0 are padding.
    T_last_reference: Float[AnyArray, "r 4 4"]
    points: Float[AnyArray, "r p 3"]
    surfaces: Float[AnyArray, "r 4 h w"]
    weights: Float[AnyArray, " r"]


@kept_jit()
def _agreements(
    T_last_scan: Float[Array, "m 4 4"],
    points: Float[Array, "p 3"],
    surface: Float[Array, "4 h w"],
    references: _References,
    pinhole: Pinhole,
    tolerance: Float[Array, ""],
) -> Agreement:
    """Computes the agreement of an image with its references at each motion."""
    everything = jnp.ones(len(points), bool)
    view = Views(PixelSample(points, everything), surface)

    def at(T: Float[Array, "4 4"]) -> Agreement:
        def against(T_last_ref: Any, points_ref: Any, surface_ref: Any) -> Agreement:
            other = Views(PixelSample(points_ref, everything), surface_ref)
            return both_ways(rigid.matmul(rigid.inverse(T_last_ref), T), view, other, pinhole, tolerance)

        agreements = jax.vmap(against)(*references[:3])
        return Agreement(*((references.weights * values).sum() for values in agreements))

    return jax.lax.map(at, T_last_scan, batch_size=128)


class _Search(NamedTuple):
    # An image, the earlier images that it is compared with, the last one first, and the sample of their points.
    references: list[DepthView]
    T_last_reference: Poses
    view: DepthView
    camera: DepthCamera
    sample: int
    num_points: int = NUM_POINTS

    def scores(self, T_last_scan: Poses, tolerance: float, num_references: int) -> Float[np.ndarray, " m"]:
        """Computes the consistency of the image with its references at motions, less the cost of the motions."""
        total, comparable = np.zeros(len(T_last_scan)), np.zeros(len(T_last_scan))
        for first in range(0, min(num_references, len(self.references)), _NUM_REFERENCES):
            rows = np.arange(first, first + _NUM_REFERENCES)
            is_there = rows < len(self.references)
            chosen = self._chosen(np.where(is_there, rows, 0), is_there)
            for begin in range(0, len(total), _NUM_SCORED):
                part = slice(begin, begin + _NUM_SCORED)
                T = np.resize(T_last_scan[part], (_NUM_SCORED, 4, 4)).astype(np.float32)
                inputs = self._points(self.view), self.view.surface, chosen, self.camera.pinhole, np.float32(tolerance)
                found = _agreements(T, *inputs)
                count = len(total[part])
                total[part] += np.asarray(found.total, np.float64)[:count]
                comparable[part] += np.asarray(found.comparable, np.float64)[:count]
        return self._less_cost(total / np.maximum(comparable, 1.0), T_last_scan)

    def _less_cost(self, consistency: Float[np.ndarray, " m"], T_last_scan: Poses) -> Float[np.ndarray, " m"]:
        is_long = np.linalg.norm(T_last_scan[:, :3, 3], axis=-1) > _LONGEST * MAX_TRANSLATION
        return np.where(is_long, -np.inf, consistency - motion_cost(T_last_scan, self.camera.motion))

    def adjusted(
        self, T_last_scan: Poses, tolerances: Float[np.ndarray, " t"]
    ) -> tuple[Poses, Float[np.ndarray, " m"]]:
        """Adjusts each motion to the surfaces of the image and its references; returns the scores, too."""
        count, num_fixed = len(T_last_scan), len(self.references)
        views = [self._sampled(view) for view in (*self.references, *[self.view] * count)]
        images = DepthImages(views, self.camera)
        own, other = np.divmod(np.arange(count * num_fixed), num_fixed)
        pairs = np.stack([np.r_[own + num_fixed, other], np.r_[other, own + num_fixed]], axis=1)
        near = pairs[pairs.min(axis=1) < _NUM_REFERENCES]
        T = np.concatenate([self.T_last_reference, T_last_scan])
        for tolerance in tolerances:
            T = adjust_poses(images, T, near, tolerance, num_iterations=_NUM_ITERATIONS, num_fixed=num_fixed)
        found = linearise_images(images, T, pairs, tolerances[-1])
        consistency = group_consistency(found, pairs.max(axis=1) - num_fixed, count)
        return T[num_fixed:], self._less_cost(consistency, T[num_fixed:])

    def _points(self, view: DepthView) -> Float[np.ndarray, "p 3"]:
        return view.samples[self.sample % len(view.samples), : self.num_points]

    def _sampled(self, view: DepthView) -> DepthView:
        return view._replace(samples=self._points(view)[None])

    def _chosen(self, rows: np.ndarray, is_there: np.ndarray) -> _References:
        views = [self.references[row] for row in rows]
        T = self.T_last_reference[rows].astype(np.float32)
        arrays = np.stack([self._points(view) for view in views]), np.stack([view.surface for view in views])
        return _References(T, *arrays, is_there.astype(np.float32))


def motions_apart(T: Poses, scores: Float[np.ndarray, " m"], count: int, shares: tuple[float, float]) -> Poses:
    """Selects the best motions that differ by these shares of the largest translation or turn from better ones.

    Args:
        T: (m, 4, 4) motions.
        scores: more is better.
        count: largest number of selected motions.
        shares: of the largest translation, and of the largest turn.

    Returns:
        The motions, the best one first; the first motion alone where no score is finite.
    """
    far, turn = shares[0] * MAX_TRANSLATION, shares[1] * np.deg2rad(MAX_TURN_DEG)

    def is_near(best: int) -> Bool[np.ndarray, " m"]:
        # The trace gives the angle without a logarithm.
        cosine = 0.5 * (np.einsum("ij,mij->m", T[best, :3, :3], T[:, :3, :3]) - 1.0)
        return (np.linalg.norm(T[:, :3, 3] - T[best, :3, 3], axis=-1) < far) & (cosine > np.cos(turn))

    kept = apart(scores, is_near, count)
    return T[kept] if len(kept) else T[:1]

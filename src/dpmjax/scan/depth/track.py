"""Poses of depth images in the order of time: tracking, and a beam search where an image cannot be tracked.

An image is tracked from the last motion. The pose is clear if it fits and if it fits worse after a shift along the
surfaces; then it costs hundredths of a second. Where it is not clear, motions are searched, and several trajectories
are kept as far as they differ, so that later images resolve the ambiguity. Images that see little of the last keyframe
become keyframes. Trajectories have poses of keyframes only; other images keep their pose relative to a keyframe.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dpmjax.geometry import rigid
from dpmjax.geometry.sampling import typical_range
from dpmjax.geometry.se3 import Motion
from dpmjax.scan.apart import apart
from dpmjax.scan.depth.align import (
    DepthCamera,
    DepthImages,
    DepthView,
    ImagePairs,
    PairSystems,
    adjust_poses,
    depth_view,
    linearise_images,
)
from dpmjax.scan.depth.propose import (
    MAX_TRANSLATION,
    MAX_TURN_DEG,
    NUM_CHECKED,
    SEARCH,
    motion_cost,
    propose_motions,
    turns_rad,
)
from dpmjax.scan.depth.record import DepthScans
from dpmjax.scan.depth.slide import slide_margin

# Least root mean square difference of two trajectories, as shares of the largest translation and of the largest turn.
_APART = (0.085, 0.075)
# Weight of the cost of motions relative to the explained share, and cost of a contradicted point in explained points.
_MOTION_COST, _CONTRADICTED_POINT = 3.0, 20.0
# Number of searches for an image with few distinct pasts, each with other points; with more of them, number of searches
# in addition to one for each.
_NUM_TRIES = 4
# Trajectories share a search where their last keyframes differ by less, metres and radians.
_SAME_PAST = (0.02, 0.01)
# Largest difference of the explained share of a kept trajectory from that of the best one.
_MARGIN = 0.25
# Samples of 100 points by which trajectories are compared and adjusted, and in the last adjustment.
_NUM_SAMPLES, _NUM_LAST_SAMPLES = 3, 12
# Number of last keyframes by which incomplete trajectories are compared and adjusted, and that a keyframe is compared
# with in the last adjustment: more see hardly anything of it.
_NUM_WINDOW = 24
# Number of steps of an adjustment.
_NUM_ITERATIONS = 6
# Number of trajectories in the last adjustment, and of its tolerances.
_NUM_LAST, _NUM_TOLERANCES = 4, 3
# A tracked pose is clear above this consistency, and if a shift by a share of the typical range lowers it by a margin.
# Lower limits let an image that slid along a wall pass; higher ones search images that track well.
_CLEAR_CONSISTENCY, _CLEAR_MARGIN, _SHIFT = 0.35, 0.08, 0.05
# Largest motion between a tracked image and the pose that the last motion predicts; shares of the largest motions.
_LARGEST_SURPRISE = 0.3
# Last keyframes that an image is tracked against, and keyframes around one in the last adjustment of many.
_NUM_TRACKED, _NUM_NEAR = 4, 12
# A trusted trajectory: least explained share of an image, and least lead over the best other trajectory.
_LEAST_EXPLAINED, _LEAST_LEAD = 0.15, 0.01
# An image that shares less than this of its points with the last keyframe becomes a keyframe.
_KEYFRAME_SHARE = 0.6

Poses = Float[np.ndarray, "_ 4 4"]


class PlacedImages(NamedTuple):
    """Result of `initialize_depth`.

    Attributes:
        T_world_camera: (n, 4, 4) float64 poses of all images, unit of the points; the first one is the identity.
        keyframes: (k,) rows of the keyframes.
        explained: (n,) share of the points of each image, or of the keyframe that it follows, that others explain, less
            the cost of contradicted points.
        lead: by how much the mean explained share exceeds that of the best other trajectory; at most the margin within
            which trajectories are kept.
    """

    T_world_camera: Poses
    keyframes: np.ndarray
    explained: Float[np.ndarray, " n"]
    lead: float

    @property
    def uncertain_images(self) -> tuple[int, ...]:
        """Rows of the images that hardly any other image explains, or that others contradict."""
        return tuple(np.flatnonzero(self.explained < _LEAST_EXPLAINED).tolist())

    @property
    def is_trusted(self) -> bool:
        """True where every image is explained and no other trajectory explains the images as well."""
        return not self.uncertain_images and self.lead >= _LEAST_LEAD


def initialize_depth(
    scans: DepthScans,
    motion: Motion = "planar",
    *,
    key: jax.Array,
    on_image: Callable[[int, int], None] = lambda num_placed, num_all: None,
) -> PlacedImages:
    """Searches the poses of all images, the first at the origin.

    Args:
        scans: images in order of time, metres; neighbours overlap.
        motion: "planar": a level camera on wheels. "full": a hand-held camera with six degrees of freedom, small
            motions between images, and the noise of a real sensor.
        key: of the search.
        on_image: called with the number of images that have poses and of all images, before the search of each.

    Returns:
        PlacedImages.
    """
    camera = DepthCamera(scans.pinhole, float(typical_range(scans.points, scans.mask)), motion)
    num_images = scans.mask.shape[0]
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    views = [depth_view(scans, 0, camera, rng)]
    beam = _Beam(camera, views[:], np.eye(4)[None, None], (_Place(0, np.eye(4)),))
    for image in range(1, num_images):
        on_image(image, num_images)
        views.append(depth_view(scans, image, camera, rng))
        found = _tracked(beam, views[-1])
        if found is None and not beam.places[-1].is_keyframe:
            # The last image is nearer than the last keyframe.
            beam = beam.promoted(views[-2])
            found = _tracked(beam, views[-1])
        if found is None:
            beam = beam.searched(views[-1], rng)
        elif found.visible < _KEYFRAME_SHARE:
            beam = beam.extended(views[-1], found.T_keyframe_image)
        else:
            beam = beam._replace(places=(*beam.places, _Place(beam.last, found.T_keyframe_image, is_keyframe=False)))
    on_image(num_images, num_images)
    return _finished(beam, views)


class _Place(NamedTuple):
    # The pose of an image relative to a keyframe.
    keyframe: int
    T_keyframe_image: Float[np.ndarray, "4 4"]
    is_keyframe: bool = True


class _Tracked(NamedTuple):
    # A clear pose relative to the last keyframe, and the share of the points that both see.
    T_keyframe_image: Float[np.ndarray, "4 4"]
    visible: float


class _Beam(NamedTuple):
    # Trajectories (h, m, 4, 4) of the m keyframes, the best one first, and the places of all images so far.
    camera: DepthCamera
    views: list[DepthView]
    T: Float[np.ndarray, "h m 4 4"]
    places: tuple[_Place, ...]

    @property
    def last(self) -> int:
        """Row of the last keyframe."""
        return len(self.views) - 1

    def promoted(self, view: DepthView) -> _Beam:
        """Makes the last image a keyframe."""
        beam = self._replace(places=self.places[:-1])
        return beam.extended(view, self.places[-1].T_keyframe_image)

    def extended(self, view: DepthView, T_keyframe_image: Float[np.ndarray, "4 4"]) -> _Beam:
        """Adds a keyframe at a clear pose."""
        ends = list((self.T[:, -1] @ T_keyframe_image)[:, None])
        return self._with_keyframe(view, np.arange(len(self.T)), ends)

    def searched(self, view: DepthView, rng: np.random.Generator) -> _Beam:
        """Adds a keyframe whose motion is searched from each distinct recent past, and more often from the best."""
        pasts = self._distinct_pasts()
        num_searches = _NUM_TRIES if len(pasts) < _NUM_TRIES else len(pasts) + _NUM_TRIES
        origin, ends = [], []
        for k in range(num_searches):
            rows = pasts[k % len(pasts)]
            motions = propose_motions(self.T[rows[0]], self.views, view, self.camera, rng)
            origin += rows
            ends += [self.T[row, -1] @ motions for row in rows]
        return self._with_keyframe(view, np.array(origin), ends)

    def _distinct_pasts(self) -> list[list[int]]:
        """Groups the trajectories whose last keyframes have the same poses relative to each other."""
        recent = self.T[:, -NUM_CHECKED:]
        T_last_recent = rigid.inverse(recent[:, -1:]) @ recent
        pasts: list[list[int]] = []
        for row, T in enumerate(T_last_recent):
            for rows in pasts:
                apart = rigid.inverse(T_last_recent[rows[0]]) @ T
                is_same = np.linalg.norm(apart[:, :3, 3], axis=-1).max() < _SAME_PAST[0]
                if is_same and turns_rad(apart).max() < _SAME_PAST[1]:
                    rows.append(row)
                    break
            else:
                pasts.append([row])
        return pasts

    def _with_keyframe(self, view: DepthView, origin: np.ndarray, ends: Sequence[Poses]) -> _Beam:
        """Keeps the best of the continued trajectories, and adjusts them; `ends` (k, 4, 4) continue `origin`."""
        views, first = [*self.views, view], max(len(self.views) + 1 - _NUM_WINDOW, 0)
        images, tolerance = (
            DepthImages(views[first:], self.camera, _NUM_SAMPLES),
            SEARCH[self.camera.motion].tolerance[1],
        )
        continued, scores = [], []
        for row, last in zip(origin, ends, strict=True):
            before = np.broadcast_to(self.T[row], (len(last), *self.T.shape[1:]))
            continued.append(np.concatenate([before, last[:, None]], axis=1))
            scores.append(explained_shares(images, self.T[row, first:], last, tolerance))
        T, explained = np.concatenate(continued), np.concatenate(scores)
        T = _best_that_differ(T, explained - _mean_cost(T, self.camera.motion), self.camera.motion)
        pairs = _all_pairs(len(images.views))
        for one in T:
            one[first:] = adjust_poses(images, one[first:], pairs, tolerance, num_iterations=_NUM_ITERATIONS)
        places = (*self.places, _Place(len(views) - 1, np.eye(4)))
        return _Beam(self.camera, views, T, places)


def _tracked(beam: _Beam, view: DepthView) -> _Tracked | None:
    """Aligns an image from the last motion, and from none; None where the pose is not clear."""
    camera, config, (*_, last) = beam.camera, SEARCH[beam.camera.motion], beam.places
    T_keyframe_last = last.T_keyframe_image
    predicted = T_keyframe_last
    if len(beam.places) > 1:
        T_before, T_last = (beam.T[0, place.keyframe] @ place.T_keyframe_image for place in beam.places[-2:])
        predicted = T_keyframe_last @ rigid.inverse(T_before) @ T_last
    # The trajectories share the motions from the last keyframe only.
    count = min(len(beam.views), _NUM_TRACKED if len(beam.T) == 1 else 1)
    T_references = rigid.inverse(beam.T[0, -1]) @ beam.T[0, -count:]
    starts = np.stack([predicted, T_keyframe_last])
    own, other = np.divmod(np.arange(len(starts) * count), count)
    pairs = np.stack([np.r_[own + count, other], np.r_[other, own + count]], axis=1)
    images = DepthImages([*beam.views[-count:], *[view] * len(starts)], camera, _NUM_SAMPLES)
    T = np.concatenate([T_references, starts])
    for tolerance in config.tolerances:
        T = adjust_poses(images, T, pairs, tolerance, num_iterations=2, num_fixed=count)
    images = DepthImages([*beam.views[-count:], view], camera, _NUM_SAMPLES)
    distance, tolerance = _SHIFT * camera.unit, config.tolerances[-1]
    checked = [
        (*slide_margin(images, np.concatenate([T_references, found[None]]), tolerance, distance), found)
        for found in T[count:]
    ]
    consistency, margin, found = max(checked, key=lambda one: one[0])
    surprise = rigid.inverse(predicted) @ found
    is_far = np.linalg.norm(surprise[:3, 3]) > _LARGEST_SURPRISE * MAX_TRANSLATION
    is_far |= turns_rad(surprise[None])[0] > _LARGEST_SURPRISE * np.deg2rad(MAX_TURN_DEG)
    if consistency < _CLEAR_CONSISTENCY or margin < _CLEAR_MARGIN or is_far:
        return None
    pair = DepthImages([beam.views[-1], view], camera, _NUM_SAMPLES)
    systems = linearise_images(pair, np.stack([np.eye(4), found]), _all_pairs(2), tolerance)
    return _Tracked(found, float(systems.visible.mean()))


def _finished(beam: _Beam, views: list[DepthView]) -> PlacedImages:
    """Adjusts all keyframes at falling tolerances, then the images between, and selects the best trajectory."""
    camera, config = beam.camera, SEARCH[beam.camera.motion]
    images, T = DepthImages(beam.views, camera, _NUM_LAST_SAMPLES), beam.T[:_NUM_LAST].copy()
    shares, explained = [], []
    for one in T:
        pairs = _near_pairs(one, camera.unit)
        for tolerance in np.geomspace(config.tolerance[1], config.final_tolerance, _NUM_TOLERANCES):
            one[:] = adjust_poses(images, one, pairs, tolerance, num_iterations=_NUM_ITERATIONS)
        found = linearise_images(images, one, pairs, config.final_tolerance)
        shares.append(_shares(_evidence(found, pairs[:, 0], len(one))))
        explained.append(float(shares[-1].mean()))
    scores = np.array(explained) - _mean_cost(T, camera.motion)
    best = int(np.argmax(scores))
    others = scores[_differs(T, T[best])]
    lead = min(_MARGIN, scores[best] - others.max()) if len(others) else _MARGIN
    rows = np.array([place.keyframe for place in beam.places])
    keyframes = np.flatnonzero([place.is_keyframe for place in beam.places])
    T_world_camera = T[best][rows] @ np.stack([place.T_keyframe_image for place in beam.places])
    between = np.setdiff1d(np.arange(len(rows)), keyframes)
    if len(between):
        T_world_camera[between] = _adjusted_between(
            images, T[best], [views[k] for k in between], T_world_camera[between], rows[between]
        )
    return PlacedImages(T_world_camera, keyframes, shares[best][rows], float(lead))


def _adjusted_between(
    images: DepthImages, T_world_keyframe: Poses, views: list[DepthView], T_world_camera: Poses, rows: np.ndarray
) -> Poses:
    """Adjusts images that are no keyframes to the keyframe before them and the next one."""
    config, count = SEARCH[images.camera.motion], len(T_world_keyframe)
    nodes = np.arange(len(views)) + count
    after = np.minimum(rows + 1, count - 1)
    ends = (nodes, rows), (rows, nodes), (nodes, after), (after, nodes)
    pairs = np.concatenate([np.stack(pair, axis=1) for pair in ends])
    everything = DepthImages([*images.views, *views], images.camera, _NUM_SAMPLES)
    T = np.concatenate([T_world_keyframe, T_world_camera])
    for tolerance in np.geomspace(config.tolerance[1], config.final_tolerance, _NUM_TOLERANCES):
        T = adjust_poses(everything, T, pairs, tolerance, num_iterations=3, num_fixed=count)
    return T[count:]


def _all_pairs(count: int) -> ImagePairs:
    return np.argwhere(~np.eye(count, dtype=bool))


def _near_pairs(T_world_camera: Poses, unit: float) -> ImagePairs:
    """Returns the pairs of each image with the images around it, in both directions."""
    count = len(T_world_camera)
    if count <= _NUM_WINDOW:
        return _all_pairs(count)
    T = rigid.inverse(T_world_camera)[:, None] @ T_world_camera
    apart = np.linalg.norm(T[..., :3, 3], axis=-1) / unit + turns_rad(T)
    nearest = np.argsort(apart, axis=1)[:, : _NUM_NEAR + 1]
    is_near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= 2
    np.put_along_axis(is_near, nearest, True, axis=1)
    return np.argwhere((is_near | is_near.T) & ~np.eye(count, dtype=bool))


def _evidence(systems: PairSystems, image: np.ndarray, count: int) -> np.ndarray:
    """Returns the best match and the largest contradiction (2, n, q) of each point of n images over all pairs.

    Each point counts once, so views by many images are not favoured.
    """
    best = np.zeros((2, count, systems.match.shape[1]))
    for kept, found in zip(best, (systems.match, systems.contradiction), strict=True):
        np.maximum.at(kept, image, found)
    return best


def _shares(evidence: np.ndarray) -> np.ndarray:
    """Returns the share of the points of each image that others explain, less the cost of contradicted points."""
    match, contradiction = evidence
    return np.asarray((match - _CONTRADICTED_POINT * contradiction).mean(axis=-1))


def explained_shares(
    images: DepthImages, T_world_camera: Poses, T_world_last: Float[np.ndarray, "k 4 4"], tolerance: float
) -> Float[np.ndarray, " k"]:
    """Computes the share of the points that another image explains, less the cost of contradicted points.

    Args:
        images: n + 1 views and their camera.
        T_world_camera: (n, 4, 4) poses of all images but the last one.
        T_world_last: (k, 4, 4) poses of the last image; each gives one trajectory.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        (k,) shares, -20 to 1.
    """
    count, num_last = len(T_world_camera), len(T_world_last)
    pairs = _all_pairs(count)
    before = linearise_images(images, T_world_camera, pairs, tolerance)
    candidates = images._replace(views=[*images.views[:-1], *[images.views[-1]] * num_last])
    nodes, T = np.arange(num_last) + count, np.concatenate([T_world_camera, T_world_last])
    new, old = (x.ravel() for x in np.meshgrid(nodes, np.arange(count), indexing="ij"))
    there, back = (
        linearise_images(candidates, T, np.stack(ends, axis=1), tolerance) for ends in ((new, old), (old, new))
    )
    own, others = (
        np.stack([found.match, found.contradiction]).reshape(2, num_last, count, -1) for found in (there, back)
    )
    others = np.maximum(others, _evidence(before, pairs[:, 0], count)[:, None])
    return _shares(np.concatenate([others, own.max(axis=2, keepdims=True)], axis=2)).mean(axis=1)


def _mean_cost(T_world_camera: Float[np.ndarray, "h n 4 4"], motion: Motion) -> Float[np.ndarray, " h"]:
    """Computes the mean cost of the motions of each trajectory."""
    motions = rigid.inverse(T_world_camera[:, :-1]) @ T_world_camera[:, 1:]
    if motions.shape[1] == 0:
        return np.zeros(len(T_world_camera))
    return np.asarray(_MOTION_COST * motion_cost(motions, motion).mean(axis=1))


def _best_that_differ(T: Float[np.ndarray, "k n 4 4"], scores: Float[np.ndarray, " k"], motion: Motion) -> np.ndarray:
    """Selects the best trajectories that differ from all better ones, best first."""
    good = np.where(scores >= scores.max() - _MARGIN, scores, -np.inf)
    return T[apart(good, lambda best: ~_differs(T, T[best]), SEARCH[motion].num_trajectories)]


def _differs(T: Float[np.ndarray, "k n 4 4"], best: Float[np.ndarray, "n 4 4"]) -> np.ndarray:
    """Returns True for trajectories (k,) that are another answer than the best one."""
    far, turn = _APART[0] * MAX_TRANSLATION, _APART[1] * np.deg2rad(MAX_TURN_DEG)
    apart = np.sqrt(np.mean(np.sum((T[..., :3, 3] - best[:, :3, 3]) ** 2, axis=-1), axis=-1))
    return np.asarray((apart >= far) | (turns_rad(rigid.inverse(best) @ T).max(axis=-1) >= turn))

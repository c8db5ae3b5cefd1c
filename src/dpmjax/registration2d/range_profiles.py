"""Range profiles: range as a function of the bearing, and hits of one scan that match or contradict another scan.

A profile has, for each bearing, the range and the slant of the surface, and the free space in front of it. A hit of
another scan lies on that surface (a match), in that free space (a contradiction), or in an unobserved region. The score
of two scans is the agreement of their visible beams.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dpmjax.geometry import se2
from dpmjax.registration2d.planar_scans import Booleans, Floats, Indices, PlanarScans, Tolerances, batches
from dpmjax.types import AnyArray

# A bearing is not seen where the two beams around it are farther apart than this many times an even spread.
_MAX_GAP = 2.5
# Least cosine of the slant of a surface. Surfaces with a smaller cosine do not correct the range of a beam.
_MIN_COSINE = 0.3
_UNKNOWN_COSINE = 0.7
# Largest sine by which a visible surface is turned away from the viewer.
_MAX_AVERTED = 0.1
# Odd minimax polynomial of the arctangent on [0, 1], the highest power first.
_ARCTANGENT = (-0.01171913, 0.05264734, -0.11642647, 0.19354037, -0.33262283, 0.99997722)
# Bearings of a profile.
_NUM_BEARINGS = 512
# Number of matched beams that outweigh a contradicting one; share of visible beams that noise makes contradictory.
_CONTRADICTION_WEIGHT, _NOISY_SHARE = 2.5, 0.02
# Regularisation of the score where few beams are visible, as a share of all beams.
LEAST_VISIBLE = 0.3
# A step with a lower score is weak.
WEAK_SCORE = 0.25
# Pairs that are compared at a time, all batches of one shape; many calls have only a few hundred.
_BATCH = 256


class RangeProfiles(flax.struct.PyTreeNode):
    """Scans over c bearings; bearing k is 2 pi (k + 0.5) / c counter-clockwise from the scan's x axis.

    Attributes:
        scans: the scans, their ranges smoothed along the fitted lines.
        surface: range of the surface, on the chord between the two beams around the bearing.
        near: the smaller range of the two beams; nearer points are free.
        far: the larger range of the two beams; farther points are hidden.
        slant: cosine of the angle between beam and surface normal, at least 0.3.
        is_seen: True between two neighbouring beams.
    """

    scans: PlanarScans
    surface: Float[Array, "*n c"]
    near: Float[Array, "*n c"]
    far: Float[Array, "*n c"]
    slant: Float[Array, "*n c"]
    is_seen: Bool[Array, "*n c"]

    def __len__(self) -> int:
        return len(self.scans)

    def take(self, rows: Any) -> RangeProfiles:
        """Returns the profiles of these rows."""
        return jax.tree.map(lambda x: x[rows], self)


class ViewComparison(NamedTuple):
    """Beams of two scans that match or contradict each other at a relative pose, both directions added.

    Attributes:
        matched: hits on the surface of the partner scan, on the side that faces it; near misses count as fractions.
        contradicted: hits in the free space of the partner scan.
        visible: hits at bearings that the partner scan has measured, not farther than its surface.
    """

    matched: Float[AnyArray, "..."]
    contradicted: Float[AnyArray, "..."]
    visible: Float[AnyArray, "..."]


def _smooth_ranges(scans: PlanarScans) -> Float[Array, "n b 2"]:
    """Moves points along their beams onto their fitted lines, which averages the range noise of a wall."""
    reach = jnp.linalg.norm(scans.points, axis=-1)
    beam = scans.points / jnp.maximum(reach, 1e-9)[..., None]
    slope = jnp.sum(scans.normals * beam, -1)
    on_line = jnp.sum(scans.normals * scans.centroids, -1) / jnp.where(jnp.abs(slope) > 1e-3, slope, 1.0)
    is_near = jnp.abs(on_line - reach) < 4.0 * scans.noises[:, None]
    usable = scans.is_on_line & (jnp.abs(slope) > _MIN_COSINE) & is_near
    return beam * jnp.where(usable, on_line, reach)[..., None]


def make_profiles(scans: PlanarScans, num_bearings: int = _NUM_BEARINGS) -> RangeProfiles:
    """Makes range profiles of planar scans.

    Args:
        scans: n scans.
        num_bearings: c; larger values make comparisons of noise-free scans more accurate.

    Returns:
        RangeProfiles with arrays (n, c).
    """
    # Profiles do not depend on the order of the scans; one program serves both.
    return _make_profiles(replace(scans, is_ordered=False), num_bearings=num_bearings)


@partial(jax.jit, static_argnames="num_bearings")
def _make_profiles(scans: PlanarScans, *, num_bearings: int) -> RangeProfiles:
    return jax.vmap(partial(_profile, num_bearings=num_bearings))(replace(scans, points=_smooth_ranges(scans)))


def _profile(scan: PlanarScans, num_bearings: int) -> RangeProfiles:
    """Makes the profile of one scan."""
    points, valid = scan.points, scan.mask
    reach = jnp.maximum(jnp.linalg.norm(points, axis=-1), 1e-9)
    cosine = jnp.maximum(jnp.abs(jnp.sum(scan.normals * points, -1)) / reach, _MIN_COSINE)
    slant = jnp.where(scan.is_on_line, cosine, _UNKNOWN_COSINE)
    angle = jnp.where(valid, jnp.mod(jnp.arctan2(points[:, 1], points[:, 0]), 2 * jnp.pi), jnp.inf)
    order = jnp.argsort(angle)
    sorted_angle, sorted_points, sorted_slant = angle[order], points[order], slant[order]
    count = jnp.maximum(valid.sum(), 1)
    bearing = 2 * jnp.pi * (jnp.arange(num_bearings) + 0.5) / num_bearings
    index = jnp.searchsorted(sorted_angle, bearing)
    before, after = (index - 1) % count, index % count
    gap = jnp.mod(jnp.where(valid.any(), sorted_angle[after] - sorted_angle[before], 0.0), 2 * jnp.pi)
    one, other = sorted_points[before], sorted_points[after]
    chord = other - one
    across = jnp.cos(bearing) * chord[:, 1] - jnp.sin(bearing) * chord[:, 0]
    along = one[:, 0] * chord[:, 1] - one[:, 1] * chord[:, 0]
    ends = jnp.linalg.norm(jnp.stack([one, other]), axis=-1)
    near, far = ends.min(0), ends.max(0)
    surface = jnp.clip(along / jnp.where(jnp.abs(across) > 1e-9, across, 1.0), near, far)
    # Padding behind the last valid beam is no beam.
    num_beams = jnp.max(jnp.where(valid, jnp.arange(1, len(valid) + 1), 1))
    is_seen = (gap < _MAX_GAP * 2 * jnp.pi / num_beams) & (count > 1)
    return RangeProfiles(scan, surface, near, far, jnp.minimum(sorted_slant[before], sorted_slant[after]), is_seen)


def _bearing(points: Float[Array, "b 2"]) -> Float[Array, " b"]:
    """Computes the bearing in [0, 2 pi] to 2e-6 radians by a polynomial, which is quicker than an exact arctangent."""
    x, y = jnp.abs(points[:, 0]), jnp.abs(points[:, 1])
    slope = jnp.minimum(x, y) / jnp.maximum(jnp.maximum(x, y), 1e-12)
    octant = slope * jnp.polyval(jnp.asarray(_ARCTANGENT, slope.dtype), slope**2)
    quadrant = jnp.where(y > x, 0.5 * jnp.pi - octant, octant)
    half = jnp.where(points[:, 0] < 0, jnp.pi - quadrant, quadrant)
    return jnp.where(points[:, 1] < 0, 2 * jnp.pi - half, half)


def _view(scan: PlanarScans, pose: Float[Array, " 3"], viewer: RangeProfiles, tolerances: Tolerances) -> ViewComparison:
    """Compares the hits of a scan with the profile of a viewer; `pose` is T_viewer_scan."""
    points = se2.transform_points(pose, scan.points)
    normals = jnp.matmul(scan.normals, se2.rotation(pose[2]).T, precision="highest")
    count = viewer.surface.shape[-1]
    k = jnp.minimum((_bearing(points) * (count / (2 * jnp.pi))).astype(jnp.int32), count - 1)
    distance = jnp.linalg.norm(points, axis=-1)
    near, far, slant = viewer.near[k], viewer.far[k], viewer.slant[k]
    is_jump = far - near > tolerances.jump
    to_edge = jnp.minimum(jnp.abs(distance - near), jnp.abs(distance - far))
    off = jnp.where(is_jump, to_edge, jnp.abs(distance - viewer.surface[k])) * slant
    counts = (scan.mask & viewer.is_seen[k]).astype(points.dtype)
    # A thin wall has two sides, and two rooms that share it must not match through it.
    is_facing = jnp.sum(points * normals, axis=-1) <= _MAX_AVERTED * distance
    matched = counts * is_facing * jnp.exp(-0.5 * (off / tolerances.match) ** 2)
    contradicted = counts * (distance < near - tolerances.contradict / slant)
    visible = counts * (distance < far + tolerances.contradict / slant)
    return ViewComparison(matched.sum(), contradicted.sum(), visible.sum())


def compare_pair(
    source: RangeProfiles, target: RangeProfiles, pose: Float[Array, " 3"], tolerances: Tolerances, *, stride: int = 1
) -> ViewComparison:
    """Compares two scans in both directions, every `stride`-th beam; `pose` is x, y, heading of T_target_source."""
    there = _view(source.scans.thin(stride), pose, target, tolerances)
    back = _view(target.scans.thin(stride), se2.inverse(pose), source, tolerances)
    return ViewComparison(*(a + b for a, b in zip(there, back, strict=True)))


@partial(jax.jit, static_argnames="stride")
def _compare(
    profiles: RangeProfiles, pairs: tuple[Array, Array, Array], tolerances: Tolerances, *, stride: int
) -> ViewComparison:
    """Compares pairs, each a source, a target and a pose."""

    def compare(pair: tuple[Array, Array, Array]) -> ViewComparison:
        return compare_pair(profiles.take(pair[0]), profiles.take(pair[1]), pair[2], tolerances, stride=stride)

    return jax.lax.map(compare, pairs, batch_size=64)


def compare_pairs(
    profiles: RangeProfiles,
    source: Indices,
    target: Indices,
    poses: Floats,
    *,
    stride: int = 2,
    match_tolerance: float | None = None,
) -> ViewComparison:
    """Compares p pairs of scans at given relative poses, at the tolerances of the scans.

    Args:
        profiles: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, 3) T_target_source.
        stride: every `stride`-th beam is compared.
        match_tolerance: of a hit about its surface, instead of that of the scans.

    Returns:
        ViewComparison with float64 arrays (p,) on the host.
    """
    tolerances, result = profiles.scans.tolerances, np.zeros((3, len(source)))
    if match_tolerance is not None:
        tolerances = tolerances._replace(match=match_tolerance)
    for part, rows in batches(len(source), _BATCH):
        pairs = source[rows], target[rows], poses[rows].astype(np.float32)
        found = _compare(profiles, pairs, tolerances, stride=stride)
        result[:, part] = stride * np.stack(found).astype(np.float64)[:, : part.stop - part.start]
    return ViewComparison(*result)


def contradicted_share(profiles: RangeProfiles, source: Indices, target: Indices, poses: Floats) -> Floats:
    """Computes the share (p,) of the visible beams of two scans that contradict each other, of at least 20 beams."""
    views = compare_pairs(profiles, source, target, poses, stride=1)
    return np.asarray(views.contradicted, np.float64) / np.maximum(np.asarray(views.visible, np.float64), 20.0)


def find_evidence(profiles: RangeProfiles, source: Indices, target: Indices, poses: Floats) -> tuple[Floats, Floats]:
    """Compares pairs of scans at T_target_source (p, 3).

    Args:
        profiles: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, 3) T_target_source.

    Returns:
        Agreement (p,), which is matched less weighted contradicting beams, and beams (p,) that end in the visible
        region of their partner scan; shares of all beams of both scans.
    """
    views = compare_pairs(profiles, source, target, poses, stride=4)
    contradicted = np.maximum(views.contradicted - _NOISY_SHARE * views.visible, 0.0)
    num_beams = np.asarray(profiles.scans.mask.sum(1), np.float64)
    beams = np.maximum(num_beams[source] + num_beams[target], 1.0)
    agreement = np.asarray(views.matched - _CONTRADICTION_WEIGHT * contradicted, np.float64)
    return agreement / beams, np.asarray(views.visible, np.float64) / beams


def pair_scores(profiles: RangeProfiles, source: Indices, target: Indices, poses: Floats) -> Floats:
    """Computes the scores (p,) of pairs at T_target_source, at most 1: the agreement of the visible beams."""
    agreement, visible = find_evidence(profiles, source, target, poses)
    return agreement / (visible + LEAST_VISIBLE)


def weak_steps(profiles: RangeProfiles, poses: Floats, rows: Indices) -> Booleans:
    """Returns True for each of the k - 1 steps whose scan-match score is below `WEAK_SCORE`."""
    before, after = rows[:-1], rows[1:]
    return pair_scores(profiles, after, before, se2.relative(poses[before], poses[after])) < WEAK_SCORE

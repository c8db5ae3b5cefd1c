"""A planar scan as what it says of every direction: where the surface is, how it is slanted, what is free before it.

With it, hits of one scan are judged by another in a few operations a beam: they lie on its surface, or in its free
space (a contradiction), or where it cannot see.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from dpmjax.registration.cores import on_all_cores
from dpmjax.registration.line_fitting import LineScans
from dpmjax.types import AnyArray

_matmul = partial(jnp.matmul, precision="highest")

# Beams farther apart than so many times an even spread leave a gap that says nothing.
_MAX_GAP = 2.5
# Surfaces that are more slanted than this count as no more slanted, and do not correct the range of a beam.
_MIN_COSINE = 0.3
_UNKNOWN_COSINE = 0.7
# Walls that are turned away from the viewer by more than this sine are not the ones it sees.
_MAX_AVERTED = 0.1
# Pairs that are judged at a time, all batches of one shape; many calls have but a few hundred.
_BATCH = 256


@flax.struct.dataclass
class Profiles:
    """Scans over the direction: bearing k of c is 2 pi (k + 0.5) / c counter-clockwise from the scan's x axis.

    Attributes:
        points: hits, their ranges smoothed along walls.
        mask: beams that measured something.
        normals: unit normals of the walls that were hit, towards the sensor; zero where there is no line.
        surface: distance of the surface, on the chord between the two beams around the bearing.
        near: the smaller range of the two; what is nearer is free.
        far: the larger one; what is farther is hidden.
        slant: cosine of the angle between beam and surface normal, not below 0.3.
        is_seen: there are two beams around.
    """

    points: Float[Array, "*n b 2"]
    mask: Bool[Array, "*n b"]
    normals: Float[Array, "*n b 2"]
    surface: Float[Array, "*n c"]
    near: Float[Array, "*n c"]
    far: Float[Array, "*n c"]
    slant: Float[Array, "*n c"]
    is_seen: Bool[Array, "*n c"]


class Margins(NamedTuple):
    """How exactly hits are compared, unit of the points.

    Attributes:
        match: standard deviation of a hit about the surface that it belongs to.
        cross: a hit that is farther than this in front of a surface contradicts it.
    """

    match: float | Float[Array, ""]
    cross: float | Float[Array, ""]


class _Hits(NamedTuple):
    """What one scan hit, in one frame."""

    points: Float[Array, "b 2"]
    normals: Float[Array, "b 2"]
    mask: Bool[Array, " b"]


class Verdict(NamedTuple):
    """What two scans say of each other at a relative pose; both directions added, in beams.

    Attributes:
        matched: hits on the other's surface, on the side that the other sees; parts for near misses.
        crossed: hits in the other's free space.
        seen: hits in directions that the other has measured, not farther than its surface.
    """

    matched: Float[AnyArray, "..."]
    crossed: Float[AnyArray, "..."]
    seen: Float[AnyArray, "..."]


def smooth_ranges(lines: LineScans) -> Float[Array, "n b 2"]:
    """Points moved along their beams onto the lines fitted at them: the range noise of a wall averages out."""
    reach = jnp.linalg.norm(lines.points, axis=-1)
    beam = lines.points / jnp.maximum(reach, 1e-9)[..., None]
    slope = jnp.sum(lines.normals * beam, -1)
    on_line = jnp.sum(lines.normals * lines.centroids, -1) / jnp.where(jnp.abs(slope) > 1e-3, slope, 1.0)
    is_near = jnp.abs(on_line - reach) < 4.0 * lines.noise[:, None]
    usable = lines.mask & (jnp.abs(slope) > _MIN_COSINE) & is_near
    return beam * jnp.where(usable, on_line, reach)[..., None]


@partial(jax.jit, static_argnames="num_bearings")
def make_profiles(lines: LineScans, valid: Bool[Array, "n b"], *, num_bearings: int = 512) -> Profiles:
    """Profiles of planar scans.

    Args:
        lines: n scans with lines.
        valid: (n, b) beams that measured something, also those without a line.
        num_bearings: directions.

    Returns:
        Profiles with arrays (n, num_bearings).
    """
    points = smooth_ranges(lines)
    beam = points / jnp.maximum(jnp.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    cosine = jnp.maximum(jnp.abs(jnp.sum(lines.normals * beam, -1)), _MIN_COSINE)
    slant = jnp.where(lines.mask, cosine, _UNKNOWN_COSINE)
    return jax.vmap(partial(_profile, num_bearings=num_bearings))(points, lines.normals, slant, valid)


def _profile(
    points: Float[Array, "b 2"],
    normals: Float[Array, "b 2"],
    slant: Float[Array, " b"],
    valid: Bool[Array, " b"],
    *,
    num_bearings: int,
) -> Profiles:
    angle = jnp.where(valid, jnp.mod(jnp.arctan2(points[:, 1], points[:, 0]), 2 * jnp.pi), jnp.inf)
    order = jnp.argsort(angle)
    sorted_angle, sorted_points, sorted_slant = angle[order], points[order], slant[order]
    count = jnp.maximum(valid.sum(), 1)
    bearing = 2 * jnp.pi * (jnp.arange(num_bearings) + 0.5) / num_bearings
    place = jnp.searchsorted(sorted_angle, bearing)
    before, after = (place - 1) % count, place % count
    gap = jnp.mod(jnp.where(valid.any(), sorted_angle[after] - sorted_angle[before], 0.0), 2 * jnp.pi)
    one, other = sorted_points[before], sorted_points[after]
    chord = other - one
    across = jnp.cos(bearing) * chord[:, 1] - jnp.sin(bearing) * chord[:, 0]
    along = one[:, 0] * chord[:, 1] - one[:, 1] * chord[:, 0]
    reach = jnp.linalg.norm(jnp.stack([one, other]), axis=-1)
    near, far = reach.min(0), reach.max(0)
    surface = jnp.clip(along / jnp.where(jnp.abs(across) > 1e-9, across, 1.0), near, far)
    limit = _MAX_GAP * 2 * jnp.pi / points.shape[0]
    return Profiles(
        points=points,
        mask=valid,
        normals=normals,
        surface=surface,
        near=near,
        far=far,
        slant=jnp.minimum(sorted_slant[before], sorted_slant[after]),
        is_seen=(gap < limit) & (count > 1),
    )


def _view(hits: _Hits, viewer: Profiles, margins: Margins) -> Verdict:
    """Hits in the frame of the viewer against its profile."""
    points, normals, mask = hits
    count = viewer.surface.shape[-1]
    turn = jnp.mod(jnp.arctan2(points[:, 1], points[:, 0]), 2 * jnp.pi) * (count / (2 * jnp.pi))
    k = jnp.minimum(turn.astype(jnp.int32), count - 1)
    distance = jnp.linalg.norm(points, axis=-1)
    near, far, slant = viewer.near[k], viewer.far[k], viewer.slant[k]
    is_jump = far - near > 10.0 * margins.match
    to_edge = jnp.minimum(jnp.abs(distance - near), jnp.abs(distance - far))
    off = jnp.where(is_jump, to_edge, jnp.abs(distance - viewer.surface[k])) * slant
    counts = (mask & viewer.is_seen[k]).astype(points.dtype)
    # A thin wall has two sides, and two rooms that share it must not match through it.
    is_facing = jnp.sum(points * normals, axis=-1) <= _MAX_AVERTED * distance
    matched = counts * is_facing * jnp.exp(-0.5 * (off / margins.match) ** 2)
    crossed = counts * (distance < near - margins.cross / slant)
    seen = counts * (distance < far + margins.cross / slant)
    return Verdict(matched.sum(), crossed.sum(), seen.sum())


def judge_pair(
    source: Profiles, target: Profiles, pose: Float[Array, " 3"], margins: Margins, *, stride: int = 1
) -> Verdict:
    """Both directions of one pair at `pose`, x, y, heading of T_target_source; every `stride`-th beam."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    from_source, from_target = _every(source, stride), _every(target, stride)
    there = from_source._replace(
        points=_matmul(from_source.points, rotation.T) + pose[:2], normals=_matmul(from_source.normals, rotation.T)
    )
    back = from_target._replace(
        points=_matmul(from_target.points - pose[:2], rotation), normals=_matmul(from_target.normals, rotation)
    )
    both = zip(_view(there, target, margins), _view(back, source, margins), strict=True)
    return Verdict(*(a + b for a, b in both))


def _every(scan: Profiles, stride: int) -> _Hits:
    """Every `stride`-th beam."""
    return _Hits(scan.points[::stride], scan.normals[::stride], scan.mask[::stride])


@partial(jax.jit, static_argnames="stride")
def _judge(
    profiles: Profiles, source: Int[Array, " p"], target: Int[Array, " p"], poses: Float[Array, "p 3"],
    margins: Margins, *, stride: int,
) -> Verdict:  # fmt: skip
    def one(pair: tuple[jax.Array, jax.Array, jax.Array]) -> Verdict:
        i, j, pose = pair
        return judge_pair(
            jax.tree.map(lambda x: x[i], profiles), jax.tree.map(lambda x: x[j], profiles), pose, margins, stride=stride
        )

    return jax.lax.map(one, (source, target, poses), batch_size=64)


def judge_pairs(
    profiles: Profiles,
    source: NDArray[np.int64],
    target: NDArray[np.int64],
    poses: NDArray[np.float64],
    *,
    margins: Margins,
    stride: int = 2,
) -> Verdict:
    """Verdicts on p relative poses.

    Args:
        profiles: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, 3) T_target_source.
        margins: how near is a match, how far in front a contradiction.
        stride: every so manyth beam is asked.

    Returns:
        Verdict with float64 arrays (p,) on the host.
    """
    result = np.zeros((3, len(source)))

    def judge(start: int) -> None:
        rows = np.resize(np.arange(start, min(start + _BATCH, len(source))), _BATCH)
        verdict = _judge(
            profiles, jnp.asarray(source[rows]), jnp.asarray(target[rows]), jnp.asarray(poses[rows], jnp.float32),
            margins, stride=stride,
        )  # fmt: skip
        part = result[:, start : start + _BATCH]
        part[:] = stride * np.stack([np.asarray(x, np.float64)[: part.shape[1]] for x in verdict])

    on_all_cores(judge, range(0, len(source), _BATCH))
    return Verdict(*result)

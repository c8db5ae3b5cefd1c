"""Line adjustment: joint estimation of all poses and of lines through the beams of several scans.

A line of one scan is as noisy as its beams. Here each beam is compared with a straight line through the beams of all
scans nearby. The weights of these beams come from the range noise: a beam at a grazing angle measures its wall well,
because its noise is parallel to the wall. The lines are eliminated, so each residual is a function of poses alone.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jaxtyping import Array, Bool, Float

from dpmjax.geometry import se2
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.pose_graph.normal_equations import solve_blocks
from dpmjax.registration2d.planar_scans import Floats, Indices, Lines, PlanarScans

_einsum = partial(jnp.einsum, precision="highest")


# The nearest beam of a neighbour, and this number of beams to either side of it, may be part of the line.
_NUM_BESIDE = 2
# In standard deviations of the range noise: half the length of line that a beam is compared with; largest distance of
# a beam from its line; deviation of walls from a straight line, which bounds the weights of grazing beams.
_WINDOW, _GATE, _ROUGHNESS = 6.0, 4.0, 0.2
# Residuals above this number of standard deviations lose most of their weight.
_OUTLIER = 3.0
# A wall is bent if the mean square of its normalised residuals is above this.
_MAX_CHI2 = 1.15
# Points are a line if their variance along it is this many times the variance across it.
_MIN_SLENDERNESS = 2.0
# Number of neighbouring scans that share lines with a scan, spread evenly by nearness within the radius, typical
# ranges.
_NUM_NEIGHBOURS, _RADIUS = 48, 1.2
# Number of times that the beams of the lines are chosen, and Gauss-Newton steps after each choice.
_NUM_ROUNDS, _NUM_ITERATIONS = 2, 2


class _Beams(NamedTuple):
    """Beams of the neighbours that may lie on the line of each beam of a scan, in its frame: (b, s, k)."""

    offsets: Float[Array, "b s k 2"]
    slant: Float[Array, "b s k 2"]
    levers: Float[Array, "b s k 2"]
    mask: Bool[Array, "b s k"]


class _Lines(NamedTuple):
    """The line of each beam (b).

    Attributes:
        normals: of the lines, on the same side as those of the beams.
        shares: weights of the surrounding beams; their weighted sum is the point where the beam meets the line.
        variance: of this point across the line.
        is_line: True where the line is straight and has enough beams.
    """

    normals: Float[Array, "b 2"]
    shares: Float[Array, "b s k"]
    variance: Float[Array, " b"]
    is_line: Bool[Array, " b"]


def _levers(points: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Computes the derivatives of points with respect to the heading of their scan."""
    return jnp.stack([-points[..., 1], points[..., 0]], -1)


@jax.jit
def _find_nearest(own: Lines, others: Lines, poses: Float[Array, "s 3"]) -> Int[Array, "b s"]:
    """Finds the beam of each neighbouring scan that ends nearest to each beam."""
    search = jax.vmap(lambda some, mask: k_nearest(own.points, some, 1, mask=mask).indices[:, 0], out_axes=1)
    return search(se2.transform_points(poses, others.points), others.mask)


def _gather_beams(own: Lines, others: Lines, nearest: Int[Array, "b s"], poses: Array, noise: Array) -> _Beams:
    """Gathers, for each beam, the beams of nearby scans that hit the same side of the same surface."""
    turn = partial(_einsum, "sij,skj->ski", se2.rotation(poses[:, 2]))
    points = se2.transform_points(poses, others.points)
    index = nearest[..., None] + jnp.arange(-_NUM_BESIDE, _NUM_BESIDE + 1)
    is_inside = (index >= 0) & (index < points.shape[1])
    index = jnp.clip(index, 0, points.shape[1] - 1)
    scan = jnp.arange(points.shape[0])[:, None]
    reach = jnp.maximum(jnp.linalg.norm(others.points, axis=-1, keepdims=True), 1e-12)
    offsets = points[scan, index] - own.points[:, None, None]
    squared = (offsets**2).sum(-1)
    faces_same_way = _einsum("bi,bski->bsk", own.normals, turn(others.normals)[scan, index]) > 0.8
    # The beam itself is left out.
    is_near = (squared < (_WINDOW * noise) ** 2) & (squared > (1e-3 * noise) ** 2)
    slant, levers = (turn(x)[scan, index] for x in (others.points / reach, _levers(others.points)))
    mask = others.mask[scan, index] & is_inside & is_near & faces_same_way
    return _Beams(offsets, slant, levers, mask)


def _fit_lines(beams: _Beams, normals: Float[Array, "b 2"], noise: Float[Array, ""]) -> _Lines:
    """Fits a weighted straight line to the beams around each beam, from the initial `normals`."""
    floor = (_ROUGHNESS * noise) ** 2
    taper = jnp.maximum(1.0 - (beams.offsets**2).sum(-1) / (_WINDOW * noise) ** 2, 0.0) ** 2
    for _ in range(2):
        across = _einsum("bi,bski->bsk", normals, beams.offsets)
        slant = _einsum("bi,bski->bsk", normals, beams.slant)
        counts = beams.mask & (jnp.abs(across) < _GATE * noise)
        certainty = 1.0 / (noise**2 * slant**2 + floor)
        weight = jnp.where(counts, taper * certainty, 0.0)
        total = jnp.maximum(weight.sum((1, 2)), 1e-12)
        mean = _einsum("bsk,bski->bi", weight, beams.offsets) / total[:, None]
        centred = beams.offsets - mean[:, None, None]
        spread = _einsum("bsk,bski,bskj->bij", weight, centred, centred) / total[:, None, None]
        difference = 0.5 * (spread[:, 0, 0] - spread[:, 1, 1])
        radius = jnp.hypot(difference, spread[:, 0, 1])
        angle = 0.5 * jnp.arctan2(spread[:, 0, 1], difference)
        fitted = jnp.stack([-jnp.sin(angle), jnp.cos(angle)], -1)
        fitted = jnp.where((fitted * normals).sum(-1, keepdims=True) < 0, -fitted, fitted)
        half_sum = 0.5 * (spread[:, 0, 0] + spread[:, 1, 1])
        is_slender = half_sum + radius > _MIN_SLENDERNESS * (half_sum - radius)
        normals = jnp.where(is_slender[:, None], fitted, normals)
    stray = (weight * _einsum("bi,bski->bsk", normals, centred) ** 2).sum((1, 2))
    chi2 = stray / jnp.maximum(jnp.where(counts, taper, 0.0).sum((1, 2)), 1e-12)
    along = _einsum("bi,bski->bsk", _levers(normals), centred)
    here = -(_levers(normals) * mean).sum(-1)
    length = jnp.maximum((weight * along**2).sum((1, 2)), 1e-12)
    shares = weight * (1.0 / total[:, None, None] + along * (here / length)[:, None, None])
    is_line = is_slender & (chi2 < _MAX_CHI2) & (counts.sum((1, 2)) > 5)
    return _Lines(normals, shares, 1.0 / total + here**2 / length, is_line)


@jax.jit
def _linearise(
    own: Lines, others: Lines, nearest: Int[Array, "b s"], poses: Float[Array, "s 3"], noise: Float[Array, ""]
) -> tuple[Float[Array, "s s 3 3"], Float[Array, "s 3"]]:
    """Computes J^T W J and J^T W r of one scan; the first of `others` is the scan itself, at pose zero."""
    beams = _gather_beams(own, others, nearest, poses, noise)
    lines = _fit_lines(beams, own.normals, noise)
    normals = lines.normals
    residual = -_einsum("bsk,bski,bi->b", lines.shares, beams.offsets, normals)
    squared_slant = (normals * own.points).sum(-1) ** 2 / jnp.maximum((own.points**2).sum(-1), 1e-12)
    variance = noise**2 * (squared_slant + _ROUGHNESS**2) + lines.variance
    robust = 1.0 / (1.0 + residual**2 / (_OUTLIER**2 * variance)) ** 2
    weight = jnp.where(own.mask & lines.is_line, robust / variance, 0.0)
    rotation = se2.rotation(poses[:, 2])
    shift = lines.shares.sum(2)[..., None] * _einsum("bi,sij->bsj", normals, rotation)
    turn = _einsum("bsk,bski,bi->bs", lines.shares, beams.levers, normals)
    own_part = jnp.concatenate([normals, (normals * _levers(own.points)).sum(-1, keepdims=True)], -1)
    jacobian = (-jnp.concatenate([shift, turn[..., None]], -1)).at[:, 0].add(own_part)
    information = _einsum("b,bsi,btj->stij", weight, jacobian, jacobian)
    return information, _einsum("b,b,bsi->si", weight, residual, jacobian)


def _choose_around(poses: Floats, radius: float) -> Indices:
    """Returns the row of each scan and those of neighbours within the radius, spread evenly by nearness.

    Where there are too few neighbours, the row of the scan itself fills the remaining places.
    """
    num_scans = len(poses)
    count = min(_NUM_NEIGHBOURS, num_scans - 1)
    tree = scipy.spatial.cKDTree(poses[:, :2])
    around = np.repeat(np.arange(num_scans)[:, None], _NUM_NEIGHBOURS + 1, axis=1)
    for scan, pose in enumerate(poses):
        num_within = tree.query_ball_point(pose[:2], radius, return_length=True)
        near = np.atleast_1d(tree.query(pose[:2], k=min(num_scans, max(num_within, count + 1)))[1])
        # Scans at the same position have no defined order.
        near = near[near != scan]
        around[scan, 1 : count + 1] = near[np.linspace(0, len(near) - 1, count).astype(np.int64)]
    return around


def adjust_to_lines(scans: PlanarScans, poses: Floats) -> Floats:
    """Optimises all poses by Gauss-Newton against lines that all scans share.

    Args:
        scans: n scans with a range noise above zero.
        poses: (n, 3) initial poses T_world_scan, within a few standard deviations of the noise.

    Returns:
        (n, 3) poses; the first is the initial one. Without noise all are the initial ones, since weights are undefined.
    """
    if len(poses) < 2 or scans.noise <= 0:
        return poses
    for _ in range(_NUM_ROUNDS):
        around = _choose_around(poses, _RADIUS * scans.typical_range)
        pairs = [_lines_around(scans, rows) for rows in around]
        relative = _relative_to_own(poses, around)
        nearest = [_find_nearest(*lines, T) for lines, T in zip(pairs, relative, strict=True)]
        for _ in range(_NUM_ITERATIONS):
            relative, noise = _relative_to_own(poses, around), np.float32(scans.noise)
            systems = [_linearise(*x, near, T, noise) for x, near, T in zip(pairs, nearest, relative, strict=True)]
            blocks, gradient = (np.stack(x).astype(np.float64) for x in zip(*systems, strict=True))
            poses = se2.compose(poses, solve_blocks(around, blocks, gradient, len(poses)))
    return poses


def _lines_around(scans: PlanarScans, rows: Indices) -> tuple[Lines, Lines]:
    """Returns the lines of the first scan, and those of all; repetitions of the first scan have none."""
    others = scans.lines(rows)
    is_other = (rows != rows[0]) | (np.arange(len(rows)) == 0)
    return scans.lines(rows[0]), others._replace(mask=others.mask & is_other[:, None])


def _relative_to_own(poses: Floats, around: Indices) -> Float[np.ndarray, "n s 3"]:
    """Returns the poses of the neighbouring scans in the frame of each scan."""
    return se2.relative(poses[around[:, 0]][:, None], poses[around]).astype(np.float32)

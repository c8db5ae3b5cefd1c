"""Line adjustment: joint estimation of all poses and of lines through the beams of several scans.

A line of one scan is as noisy as its beams. Here each beam is compared with a straight line through the beams of all
scans nearby. The weights of these beams come from the range noise: a beam at a grazing angle measures its wall well,
because its noise is parallel to the wall. The lines are eliminated, so each residual is a function of poses alone.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jaxtyping import Array, Bool, Float, Int

from dpmjax.geometry import se2
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.kept_programs import kept_jit
from dpmjax.pose_graph.normal_equations import solve_blocks
from dpmjax.scan.planar.record import Floats, Indices, Lines, PlanarScans

# The nearest beam of a neighbour, and this number of beams to either side of it, may be part of the line.
_NUM_BESIDE = 2
# In standard deviations of the range noise: half the length of line that a beam is compared with; largest distance of
# a beam from its line; deviation of walls from a straight line, which bounds the weights of grazing beams.
_WINDOW, _GATE, _ROUGHNESS = 6.0, 4.0, 0.2
# Number of neighbouring scans that share lines with a scan, spread evenly by nearness within the radius, typical
# ranges.
_NUM_NEIGHBOURS, _RADIUS = 48, 1.2
# Number of times that the beams of the lines are chosen, and Gauss-Newton steps after each choice.
_NUM_ROUNDS, _NUM_ITERATIONS = 2, 2


class _Beams(NamedTuple):
    """Beams of the neighbours that may lie on the line of each beam of a scan, in its frame: (b, s, k).

    Attributes:
        x: position relative to the beam.
        y: the same.
        along_x: position relative to the sensor that measured it.
        along_y: the same.
        mask: True for beams near the beam, on the same side of a surface.
    """

    x: Float[Array, "b s k"]
    y: Float[Array, "b s k"]
    along_x: Float[Array, "b s k"]
    along_y: Float[Array, "b s k"]
    mask: Bool[Array, "b s k"]


class _Fit(NamedTuple):
    """The line of each beam (b).

    Attributes:
        x: normal of the line, on the same side as that of the beam.
        y: the same.
        shares: weights of the surrounding beams; their weighted sum is the point where the beam meets the line.
        variance: of this point across the line.
        is_line: True where the line is straight and has enough beams.
    """

    x: Float[Array, " b"]
    y: Float[Array, " b"]
    shares: Float[Array, "b s k"]
    variance: Float[Array, " b"]
    is_line: Bool[Array, " b"]


@kept_jit()
def _find_nearest(own: Lines, others: Lines, poses: Float[Array, "s 3"]) -> Int[Array, "b s"]:
    """Finds the beam of each neighbouring scan that ends nearest to each beam."""
    search = jax.vmap(lambda some, mask: k_nearest(own.points, some, 1, mask=mask).indices[:, 0], out_axes=1)
    return search(se2.transform_points(poses, others.points), others.mask)


def _gather_beams(own: Lines, others: Lines, nearest: Int[Array, "b s"], poses: Array, noise: Array) -> _Beams:
    """Gathers, for each beam, the beams of nearby scans that hit the same side of the same surface."""
    points = se2.transform_points(poses, others.points)
    normals = se2.transform_points(poses * jnp.array([0.0, 0.0, 1.0]), others.normals)
    index = nearest[..., None] + jnp.arange(-_NUM_BESIDE, _NUM_BESIDE + 1)
    is_inside = (index >= 0) & (index < points.shape[1])
    index, scan = jnp.clip(index, 0, points.shape[1] - 1), jnp.arange(len(points))[:, None]
    found_x, found_y = points[..., 0][scan, index], points[..., 1][scan, index]
    x, y = found_x - own.points[:, :1, None], found_y - own.points[:, 1:, None]
    squared = x**2 + y**2
    cosine = own.normals[:, :1, None] * normals[..., 0][scan, index]
    cosine += own.normals[:, 1:, None] * normals[..., 1][scan, index]
    # The beam itself is left out.
    is_near = (squared < (_WINDOW * noise) ** 2) & (squared > (1e-3 * noise) ** 2)
    mask = others.mask[scan, index] & is_inside & is_near & (cosine > 0.8)
    return _Beams(x, y, found_x - poses[:, :1], found_y - poses[:, 1:2], mask)


def _fit_lines(beams: _Beams, normals: Float[Array, "b 2"], noise: Float[Array, ""]) -> _Fit:
    """Fits a weighted straight line to the beams around each beam, from the initial `normals`."""
    normal_x, normal_y = normals.T
    reach = jnp.maximum(jnp.hypot(beams.along_x, beams.along_y), 1e-12)
    taper = jnp.maximum(1.0 - (beams.x**2 + beams.y**2) / (_WINDOW * noise) ** 2, 0.0) ** 2
    for _ in range(2):
        across = _wide(normal_x) * beams.x + _wide(normal_y) * beams.y
        slant = (_wide(normal_x) * beams.along_x + _wide(normal_y) * beams.along_y) / reach
        counts = beams.mask & (jnp.abs(across) < _GATE * noise)
        weight = jnp.where(counts, taper / (noise**2 * slant**2 + (_ROUGHNESS * noise) ** 2), 0.0)
        total = jnp.maximum(weight.sum((1, 2)), 1e-12)
        mean_x, mean_y = ((weight * z).sum((1, 2)) / total for z in (beams.x, beams.y))
        x, y = beams.x - _wide(mean_x), beams.y - _wide(mean_y)
        xx, xy, yy = ((weight * z).sum((1, 2)) / total for z in (x * x, x * y, y * y))
        difference, half_sum = 0.5 * (xx - yy), 0.5 * (xx + yy)
        radius, angle = jnp.hypot(difference, xy), 0.5 * jnp.arctan2(xy, difference)
        fitted_x, fitted_y = -jnp.sin(angle), jnp.cos(angle)
        sign = jnp.where(fitted_x * normal_x + fitted_y * normal_y < 0, -1.0, 1.0)
        # Points are a line if their variance along it is this many times the variance across it.
        is_slender = half_sum + radius > 2.0 * (half_sum - radius)
        normal_x = jnp.where(is_slender, sign * fitted_x, normal_x)
        normal_y = jnp.where(is_slender, sign * fitted_y, normal_y)
    stray = (weight * (_wide(normal_x) * x + _wide(normal_y) * y) ** 2).sum((1, 2))
    chi2 = stray / jnp.maximum(jnp.where(counts, taper, 0.0).sum((1, 2)), 1e-12)
    along = _wide(normal_x) * y - _wide(normal_y) * x
    here = normal_y * mean_x - normal_x * mean_y
    length = jnp.maximum((weight * along**2).sum((1, 2)), 1e-12)
    shares = weight * (_wide(1.0 / total) + along * _wide(here / length))
    # A wall is bent if the mean square of its normalised residuals is above this.
    is_line = is_slender & (chi2 < 1.15) & (counts.sum((1, 2)) > 5)
    return _Fit(normal_x, normal_y, shares, 1.0 / total + here**2 / length, is_line)


def _wide(values: Float[Array, " b"]) -> Float[Array, "b 1 1"]:
    return values[:, None, None]


@kept_jit()
def _linearise(
    own: Lines, others: Lines, nearest: Int[Array, "b s"], poses: Float[Array, "s 3"], noise: Float[Array, ""]
) -> tuple[Float[Array, "s s 3 3"], Float[Array, "s 3"]]:
    """Computes J^T W J and J^T W r of one scan; the first of `others` is the scan itself, at pose zero."""
    beams = _gather_beams(own, others, nearest, poses, noise)
    lines = _fit_lines(beams, jnp.asarray(own.normals), noise)
    (x, y), (own_x, own_y) = (lines.x[:, None], lines.y[:, None]), own.points.T
    across = _wide(lines.x) * beams.x + _wide(lines.y) * beams.y
    residual = -(lines.shares * across).sum((1, 2))
    slant = lines.x * own_x + lines.y * own_y
    squared_slant = slant**2 / jnp.maximum(own_x**2 + own_y**2, 1e-12)
    variance = noise**2 * (squared_slant + _ROUGHNESS**2) + lines.variance
    # Residuals above this number of standard deviations lose most of their weight.
    robust = 1.0 / (1.0 + residual**2 / (3.0**2 * variance)) ** 2
    weight = jnp.where(own.mask & lines.is_line, robust / variance, 0.0)
    cos, sin, share = jnp.cos(poses[:, 2]), jnp.sin(poses[:, 2]), lines.shares.sum(2)
    turn = (lines.shares * (_wide(lines.y) * beams.along_x - _wide(lines.x) * beams.along_y)).sum(2)
    jacobian = -jnp.stack([share * (x * cos + y * sin), share * (y * cos - x * sin), turn], -1)
    jacobian = jacobian.at[:, 0].add(jnp.stack([lines.x, lines.y, lines.y * own_x - lines.x * own_y], -1))
    flat = jacobian.reshape(len(jacobian), -1)
    information = jnp.matmul(flat.T, weight[:, None] * flat, precision="highest")
    gradient = jnp.matmul(flat.T, weight * residual, precision="highest")
    size = jacobian.shape[1]
    return information.reshape(size, 3, size, 3).swapaxes(1, 2), gradient.reshape(size, 3)


def _choose_around(poses: Floats, radius: float) -> Indices:
    """Returns the row of each scan and those of neighbours within the radius, spread evenly by nearness.

    If there are too few neighbours, the row of the scan itself fills the remaining places.
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
        (n, 3) poses; the first pose does not change. Without noise no pose changes, because weights are undefined.
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

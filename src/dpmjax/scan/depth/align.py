"""Alignment of depth images by projection, of one image or of all together.

Each point is compared with the surface of another image that it is projected to, so no neighbour is searched. The
adjustment is Levenberg-Marquardt with a robust weight (Welsch). A step counts only if the consistency grows. One
program linearises a fixed number of pairs, so another number of images compiles nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se3
from dpmjax.geometry.normals import image_normals
from dpmjax.geometry.se3 import Motion
from dpmjax.kept_programs import kept_jit
from dpmjax.scan.depth.compare import UNSEEN_SHARE, agreement_of_gaps, explain_points
from dpmjax.scan.depth.record import DepthScans, Pinhole, PixelSample, image_surface, surface_slopes

# Points of one sample. Fewer make noisy scores, more make the search of motions slow.
NUM_POINTS = 100
# Pairs that are linearised by one call of the program.
_NUM_PAIRS = 128
# Damping as a share of the mean information: first value, least value, divisor after an accepted step, and factor
# after a rejected step.
_DAMPING, _LEAST_DAMPING, _BETTER, _WORSE = 1e-3, 1e-5, 4.0, 8.0

Floats = np.ndarray
Poses = Float[np.ndarray, "_ 4 4"]
ImagePairs = Int[np.ndarray, "p 2"]


class DepthView(NamedTuple):
    """One depth image on the host.

    Attributes:
        samples: (s, 100, 3) valid points in the camera frame, in random order, unit of the points.
        surface: (4, h - 1, w - 1) of `image_surface`.
        directions: (a, 3) principal axes of the normals, the least constrained direction first.
    """

    samples: Float[np.ndarray, "s p 3"]
    surface: Float[np.ndarray, "4 r c"]
    directions: Float[np.ndarray, "a 3"]


class DepthCamera(NamedTuple):
    """The camera of all images.

    Attributes:
        pinhole: its projection.
        unit: typical range of the images, unit of the points.
        motion: its degrees of freedom.
    """

    pinhole: Pinhole
    unit: float
    motion: Motion

    @property
    def axes(self) -> list[int]:
        """Rows of a twist (vx, vy, vz, wx, wy, wz) that the camera can move along."""
        return [0, 2, 4] if self.motion == "planar" else [0, 1, 2, 3, 4, 5]


def depth_view(scans: DepthScans, image: int, camera: DepthCamera, rng: np.random.Generator) -> DepthView:
    """Makes the view of one image.

    Args:
        scans: depth images.
        image: row of the image.
        camera: its camera.
        rng: draws the order of the points.

    Returns:
        The view.
    """
    points, mask = np.asarray(scans.points[image]), np.asarray(scans.mask[image])
    valid = rng.permutation(points[mask])
    # Samples of an image at least; an image with fewer valid points repeats some.
    num_samples = max(3, len(valid) // NUM_POINTS)
    samples = np.resize(valid, (num_samples, NUM_POINTS, 3))
    axes = [0, 2] if camera.motion == "planar" else [0, 1, 2]
    normals = image_normals(points, mask)[0][..., axes].reshape(-1, len(axes))
    directions = np.zeros((len(axes), 3))
    directions[:, axes] = np.linalg.eigh(normals.T @ normals)[1].T
    return DepthView(samples, np.asarray(image_surface(np.where(mask, points[..., 2], 0.0))), directions)


class PairSystems(NamedTuple):
    """Gauss-Newton systems of p pairs, in the tangents (translation, rotation) of the first cameras, and agreements.

    Attributes:
        information: (p, 6, 6) J^T W J of gaps in tolerances.
        gradient: (p, 6) J^T W r.
        total: (p,) matches less the cost of contradictions.
        comparable: (p,) see `Agreement`.
        match: (p, q) match of each point, 0 to 1.
        contradiction: (p, q) clear contradiction of each point, 0 to 1.
    """

    information: Any
    gradient: Any
    total: Any
    comparable: Any
    match: Any
    contradiction: Any

    @property
    def visible(self) -> Floats:
        """Share (p,) of the points that the target image sees."""
        return np.asarray(self.comparable / self.match.shape[1] - UNSEEN_SHARE)


class DepthImages(NamedTuple):
    """Images that are compared.

    Attributes:
        views: of each node; several nodes may hold the same view.
        camera: of all images.
        num_samples: number of samples of points of each image that are compared.
    """

    views: Sequence[DepthView]
    camera: DepthCamera
    num_samples: int = 1


@kept_jit()
def _linearise(
    samples: Float[Array, "b p 3"],
    surfaces: Float[Array, "b 4 r c"],
    T_other_camera: Float[Array, "b 4 4"],
    pinhole: Pinhole,
    unit: Float[Array, ""],
    tolerance: Float[Array, ""],
) -> PairSystems:
    def one(points: Array, surface: Array, T: Array) -> PairSystems:
        sample = PixelSample(points, jnp.ones(len(points), bool))
        gap, slopes, is_visible = surface_slopes(T, sample, surface, pinhole)
        gap, slopes = gap / tolerance, jnp.matmul(slopes, T[:3, :3], precision="highest") / tolerance
        jacobian = jnp.concatenate([slopes, jnp.cross(points, slopes)], axis=-1)
        weighted = (is_visible * jnp.exp(-0.5 * gap**2))[:, None] * jacobian
        information = jnp.matmul(weighted.T, jacobian, precision="highest")
        agreement = agreement_of_gaps(gap, is_visible, sample.mask, surface, tolerance)
        evidence = explain_points(T, points, gap * tolerance, is_visible, unit, tolerance)
        return PairSystems(information, gap @ weighted, *agreement, *evidence)

    return jax.vmap(one)(samples, surfaces, T_other_camera)


def linearise_images(images: DepthImages, T_world_camera: Poses, pairs: ImagePairs, tolerance: float) -> PairSystems:
    """Compares the points of the first image of each pair with the surface of the second.

    Args:
        images: n views and their camera.
        T_world_camera: (n, 4, 4) poses, unit of the points.
        pairs: (p, 2) rows: the camera of the points, and of the surface.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        PairSystems.
    """
    views, camera, num_samples = images
    T_other_camera = (rigid.inverse(T_world_camera)[pairs[:, 1]] @ T_world_camera[pairs[:, 0]]).astype(np.float32)
    # Nodes that hold the same view share its row in the arrays.
    distinct = {id(view): view for view in views}
    row_of = dict(zip(distinct, range(len(distinct)), strict=True))
    own, other = np.array([row_of[id(view)] for view in views])[pairs].T
    samples = np.stack([np.resize(view.samples, (num_samples, NUM_POINTS, 3)) for view in distinct.values()])
    surfaces = np.stack([view.surface for view in distinct.values()])
    # Each sample of a pair is a row; all rows go through the program in blocks of one size.
    rows, sample = np.divmod(np.arange(len(pairs) * num_samples), num_samples)
    blocks = []
    for begin in range(0, len(rows), _NUM_PAIRS):
        block = np.resize(np.arange(begin, min(begin + _NUM_PAIRS, len(rows))), _NUM_PAIRS)
        pair = rows[block]
        inputs = samples[own[pair], sample[block]], surfaces[other[pair]], T_other_camera[pair]
        found = _linearise(*inputs, camera.pinhole, np.float32(camera.unit), np.float32(tolerance))
        blocks.append([np.asarray(values, np.float64)[: len(rows) - begin] for values in found])
    if not blocks:
        return PairSystems(
            *(np.zeros(shape) for shape in ((0, 6, 6), (0, 6), 0, 0, *[(0, num_samples * NUM_POINTS)] * 2))
        )
    joined = [np.concatenate(parts).reshape(len(pairs), num_samples, -1) for parts in zip(*blocks, strict=True)]
    information, gradient, total, comparable = (values.sum(axis=1) for values in joined[:4])
    points = (values.reshape(len(pairs), -1) for values in joined[4:])
    return PairSystems(information.reshape(-1, 6, 6), gradient, total[:, 0], comparable[:, 0], *points)


def adjust_poses(
    images: DepthImages,
    T_world_camera: Poses,
    pairs: ImagePairs,
    tolerance: float,
    *,
    num_iterations: int,
    num_fixed: int = 1,
) -> Poses:
    """Adjusts poses to the surfaces of other images, as long as the projective consistency grows.

    Poses that no pair joins are adjusted independently, each with its own damping.

    Args:
        images: n views and their camera.
        T_world_camera: (n, 4, 4) initial poses, with errors of few tolerances.
        pairs: (p, 2) rows of the images that are compared, one direction a pair.
        tolerance: share of the depth; unit of the residuals.
        num_iterations: number of steps.
        num_fixed: number of first poses that do not move.

    Returns:
        (n, 4, 4) poses.
    """
    T = np.array(T_world_camera)
    here = linearise_images(images, T, pairs, tolerance)
    # Images that do not see each other have no say, and cost time.
    is_seen = here.visible > 0
    pairs, here = pairs[is_seen], PairSystems(*(values[is_seen] for values in here))
    if not len(pairs):
        return T
    group, num_groups = _groups(len(T), pairs, num_fixed)
    of_pair, damping = np.maximum(group[pairs[:, 0]], group[pairs[:, 1]]), np.full(num_groups, _DAMPING)
    score = group_consistency(here, of_pair, num_groups)
    scales = tolerance * np.array([images.camera.unit] * 3 + [1.0] * 3)
    for _ in range(num_iterations):
        system = _normal_equations(here, T, pairs, scales, images.camera.axes)
        step = np.zeros((len(T), 6))
        step[num_fixed:, images.camera.axes] = _damped_step(*system, group[num_fixed:], damping)
        moved = np.concatenate([T[:num_fixed], step_poses(T[num_fixed:], scales * step[num_fixed:])])
        there = linearise_images(images, moved, pairs, tolerance)
        tried = group_consistency(there, of_pair, num_groups)
        is_better = tried > score
        T[num_fixed:] = _chosen(is_better[group[num_fixed:]], moved[num_fixed:], T[num_fixed:])
        here = PairSystems(*(_chosen(is_better[of_pair], *sides) for sides in zip(there, here, strict=True)))
        score = np.where(is_better, tried, score)
        damping = np.where(is_better, np.maximum(damping / _BETTER, _LEAST_DAMPING), damping * _WORSE)
    return T


def _chosen(is_first: Floats, first: Floats, second: Floats) -> Floats:
    return np.where(is_first.reshape(-1, *[1] * (first.ndim - 1)), first, second)


def _groups(num_nodes: int, pairs: ImagePairs, num_fixed: int) -> tuple[Floats, int]:
    """Labels the free nodes that pairs join, directly or through others; -1 for fixed nodes."""
    joined = pairs[(pairs >= num_fixed).all(axis=1)] - num_fixed
    num_free = num_nodes - num_fixed
    graph = coo_matrix((np.ones(len(joined)), joined.T), (num_free, num_free))
    count, labels = connected_components(graph, directed=False)
    return np.concatenate([np.full(num_fixed, -1), labels]), count


def group_consistency(systems: PairSystems, group: Floats, num_groups: int) -> Floats:
    """Computes the consistency of the pairs of each group together.

    Args:
        systems: p compared pairs.
        group: (p,) labels.
        num_groups: number of labels.

    Returns:
        (num_groups,) -18 to 1; 0 where no point is visible.
    """
    total, comparable = (np.bincount(group, x, num_groups) for x in (systems.total, systems.comparable))
    return np.asarray(total / np.maximum(comparable, 1.0))


def _normal_equations(
    systems: PairSystems, T: Poses, pairs: ImagePairs, scales: Floats, axes: list[int]
) -> tuple[Floats, Floats]:
    """Returns the matrix (n, n, k, k) and the gradient (n, k) of all poses, each in its own tangent, in `scales`."""
    # A step of the second camera moves the points by minus the adjoint of T_camera_other.
    towards = -se3.adjoint(rigid.inverse(T)[pairs[:, 0]] @ T[pairs[:, 1]])
    moves = np.stack([np.broadcast_to(np.eye(6), towards.shape), towards], axis=1) * scales
    moves = moves[..., axes]
    matrix, gradient = np.zeros((len(T), len(T), len(axes), len(axes))), np.zeros((len(T), len(axes)))
    blocks = np.einsum("pski,pkl,ptlj->pstij", moves, systems.information, moves, optimize=True)
    np.add.at(matrix, (pairs[:, :, None], pairs[:, None, :]), blocks)
    np.add.at(gradient, pairs, np.einsum("pski,pk->psi", moves, systems.gradient))
    return matrix, gradient


def _damped_step(matrix: Floats, gradient: Floats, group: Floats, damping: Floats) -> Floats:
    """Computes the step (f, k) of the f last poses; each group has its damping and its longest step."""
    free, freedom = slice(len(gradient) - len(group), None), gradient.shape[1]
    matrix = matrix[free, free].transpose(0, 2, 1, 3).reshape(len(group) * freedom, -1)
    diagonal = matrix.diagonal().reshape(len(group), freedom).sum(axis=1)
    mean = np.bincount(group, diagonal) / (freedom * np.bincount(group))
    extra = np.repeat((damping * mean + _LEAST_DAMPING)[group], freedom)
    values = np.linalg.solve(matrix + np.diag(extra), -gradient[free].reshape(-1)).reshape(len(group), freedom)
    largest = np.zeros(len(damping))
    np.maximum.at(largest, group, np.abs(values).max(axis=1))
    # Longest step, in tolerances: of the typical range, and radians.
    return values * np.minimum(1.0, 4.0 / np.maximum(largest, 1e-6))[group, None]


def step_poses(T_world_camera: Poses, step: Float[np.ndarray, "n 6"]) -> Poses:
    """Moves poses in their own frames: T @ (turn, translation).

    Args:
        T_world_camera: (n, 4, 4) poses.
        step: (n, 6) translations and rotation vectors.

    Returns:
        (n, 4, 4) poses.
    """
    T = np.tile(np.eye(4), (len(step), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(step[:, 3:]).as_matrix(), step[:, :3]
    return np.asarray(T_world_camera @ T)

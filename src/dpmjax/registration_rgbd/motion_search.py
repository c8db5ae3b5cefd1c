"""Search of the motions of a depth image relative to earlier images by projective consistency.

Motions are drawn and varied from coarse to fine against the last images. An image of a wall hardly constrains the
motion along the wall, so distinct best motions are also shifted along the surfaces of the image. The best of these are
adjusted against more images. Many distinct motions are proposed, so that later images resolve the ambiguity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from dpmjax.checks import require_fields, require_one_of
from dpmjax.geometry import rigid
from dpmjax.geometry.normals import image_normals
from dpmjax.geometry.se3 import Motion, motion_matrices
from dpmjax.registration_rgbd.depth_images import DepthScans, Pinhole, Views, surface_gap
from dpmjax.registration_rgbd.projective_consistency import (
    Agreement,
    both_ways,
    gap_equations,
    improve_motions,
    motion_scales,
)

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
# Number of earlier images that an image is compared with before the shifts, and afterwards.
_NUM_REFERENCES, _NUM_CHECKED = 4, 8
# Least differences of distinct motions, as shares of the largest translation and turn: before the shifts, and after.
_DIFFERENT, _SLID_APART = (0.35, 0.1), (0.12, 0.06)
# Largest shift, and longest motion after a shift, in largest translations.
_SLIDE, _LONGEST = 1.4, 1.5
# Width of the first variations as a share of the limits; halved from round to round.
_FIRST_SPREAD = 0.25
# Number of tolerances of an adjustment, and of steps at each.
_NUM_TOLERANCES, _NUM_ITERATIONS = 4, 2


class SearchScales(NamedTuple):
    """Tolerances and costs of the search, which depend on the degrees of freedom of the camera.

    Attributes:
        tolerance: tolerance of matching points as a share of the depth, in the first and in the last round; the last
            one is also that of incomplete trajectories.
        final_tolerance: tolerance of the last adjustment and of the choice of the best trajectory.
        translation_weight: cost of the largest translation, in units of consistency. Along a bare wall, where the
            translation is unconstrained, this cost selects the shortest one.
        turn_weight: cost of the largest turn, in units of consistency.
    """

    tolerance: tuple[float, float]
    final_tolerance: float
    translation_weight: float
    turn_weight: float


# Images of a hand-held camera have the noise of a real sensor, and small motions between them: wider tolerances, and
# higher costs of motions.
_SCALES: dict[Motion, SearchScales] = {
    "planar": SearchScales((0.12, 0.02), 0.006, translation_weight=0.05, turn_weight=0.0),
    "full": SearchScales((0.12, 0.03), 0.015, translation_weight=0.2, turn_weight=0.3),
}


@dataclass(frozen=True)
class DepthSearchConfig:
    """Settings of the search.

    Attributes:
        motion: degrees of freedom of the camera; they decide the tolerances and the costs of motions.
        num_trajectories: largest number of trajectories that are kept from image to image.
        num_candidates: number of motions of the first round, spread evenly.
        num_varied: number of new motions around each kept one in a round.
    """

    motion: Motion = "planar"
    num_trajectories: int = 16
    num_candidates: int = 1024
    num_varied: int = 20

    def __post_init__(self) -> None:
        require_fields(self, "num_trajectories", "num_varied", low=1)
        require_fields(self, "num_candidates", low=_NUM_KEPT)
        require_one_of("motion", self.motion, get_args(Motion))

    @property
    def scales(self) -> SearchScales:
        """Tolerances and costs of motions."""
        return _SCALES[self.motion]


def depth_search(motion: Motion) -> DepthSearchConfig:
    """Returns the settings of the search of initial poses.

    Args:
        motion: "planar": a level camera on wheels. "full": a hand-held camera, with six degrees of freedom, small
            motions between images, and the noise of a real sensor.

    Returns:
        The settings.
    """
    if motion == "planar":
        return DepthSearchConfig()
    return DepthSearchConfig(motion="full", num_trajectories=8, num_candidates=16384, num_varied=48)


class SearchCamera(NamedTuple):
    """The camera of all images, and their typical range in the unit of the points."""

    pinhole: Pinhole
    unit: Float[Array, ""] | float


class References(NamedTuple):
    """Earlier images that an image is compared with, the last one first.

    Attributes:
        T_last_reference: poses in the frame of the last image.
        weights: 0 for padding images.
        views: the images.
    """

    T_last_reference: Float[Array, "r 4 4"]
    weights: Float[Array, " r"]
    views: Views


def surface_directions(scans: DepthScans, motion: Motion) -> NDArray[np.float32]:
    """Computes the principal axes of each image's surface normals, in order of increasing eigenvalue.

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


def propose_motions(
    T_world_camera: NDArray[np.float64],
    views: Views,
    directions: Float[Array, "n a 3"],
    camera: SearchCamera,
    config: DepthSearchConfig,
    *,
    key: jax.Array,
) -> NDArray[np.float64]:
    """Searches the best distinct motions of the next image.

    Args:
        T_world_camera: (m, 4, 4) poses of the images before the next one.
        views: all images, n > m.
        directions: axes of the surfaces in the camera frames, the least constrained direction first.
        camera: camera of the images.
        config: settings of the search.
        key: key of the search.

    Returns:
        (k, 4, 4) T_last_next, the best one first.
    """
    scan, num_scans = len(T_world_camera), views.surfaces.shape[0]
    num_checked = min(_NUM_CHECKED, num_scans - 1)
    # A window of fixed length; with fewer earlier images the first is repeated with weight 0.
    before = scan - 1 - np.arange(num_checked)
    rows = np.maximum(before, 0)
    references = References(
        jnp.asarray(np.linalg.inv(T_world_camera[-1]) @ T_world_camera[rows], jnp.float32),
        jnp.asarray(before >= 0, jnp.float32),
        _take(views, rows),
    )
    found = _search(references, _take(views, scan), directions[scan], camera, key, config=config)
    return np.asarray(found, np.float64)


def motion_cost(length: Any, turn: Any, config: DepthSearchConfig) -> Any:
    """Computes a regulariser of camera motions that is linear in translation and rotation, in units of consistency.

    Args:
        length: length of motions between neighbouring images, unit of the points.
        turn: angles of the motions, radians.
        config: settings of the search.

    Returns:
        The cost of each motion.
    """
    turn_share = turn / np.deg2rad(MAX_TURN_DEG)
    return config.scales.translation_weight * length / MAX_TRANSLATION + config.scales.turn_weight * turn_share


def _take(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def _turn_of(T: Float[Array, "... 4 4"]) -> Float[Array, "..."]:
    """Computes the angle of a motion, radians."""
    return jnp.arccos(jnp.clip(0.5 * (jnp.trace(T[..., :3, :3], axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))


class _Comparison(NamedTuple):
    """An image, and the earlier images that it is compared with.

    Attributes:
        references: earlier images.
        view: the image.
        camera: camera of all images.
        config: settings of the search.
    """

    references: References
    view: Views
    camera: SearchCamera
    config: DepthSearchConfig

    def score(self, T_last_scan: Float[Array, "4 4"], tolerance: Float[Array, ""]) -> Float[Array, ""]:
        """Computes the consistency of the image with its references at a motion, less the cost of the motion."""
        references, view = self.references, self.view

        def against(T_last_ref: Array, reference: Views) -> Agreement:
            T_ref_scan = rigid.compose(rigid.inverse(T_last_ref), T_last_scan)
            return both_ways(T_ref_scan, view, reference, self.camera.pinhole, tolerance)

        agreements = jax.vmap(against)(references.T_last_reference, references.views)
        agreement = Agreement(*(references.weights * values for values in agreements))
        length = jnp.linalg.norm(T_last_scan[:3, 3])
        score = agreement.consistency() - motion_cost(length, _turn_of(T_last_scan), self.config)
        return jnp.where(length > _LONGEST * MAX_TRANSLATION, -jnp.inf, score)

    def scores(self, T: Float[Array, "m 4 4"], tolerance: Float[Array, ""]) -> Float[Array, " m"]:
        """Computes the scores of motions, some at a time."""
        return jax.lax.map(lambda one: self.score(one, tolerance), T, batch_size=128)

    def adjusted(self, T_last_scan: Float[Array, "4 4"], tolerance: Float[Array, ""]) -> Float[Array, "4 4"]:
        """Adjusts a motion to the distances between points and surfaces of the image and its references."""
        references, view, pinhole = self.references, self.view, self.camera.pinhole
        scales = motion_scales(self.config.motion, self.camera.unit, tolerance)

        def gaps(values: Float[Array, " k"], T: Float[Array, "4 4"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
            T_last_moved = rigid.compose(T, motion_matrices((scales * values)[None])[0])

            def against(T_last_ref: Array, reference: Views) -> tuple[Float[Array, " q"], Bool[Array, " q"]]:
                T_ref_scan = rigid.compose(rigid.inverse(T_last_ref), T_last_moved)
                there = surface_gap(T_ref_scan, view.sample, reference.surfaces, pinhole)
                back = surface_gap(rigid.inverse(T_ref_scan), reference.sample, view.surfaces, pinhole)
                return jnp.concatenate([there[0], back[0]]) / tolerance, jnp.concatenate([there[1], back[1]])

            gap, is_visible = jax.vmap(against)(references.T_last_reference, references.views)
            return gap.ravel(), (is_visible * references.weights[:, None]).ravel()

        def equations(motions: Float[Array, "1 4 4"]) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
            T, here = rigid.compose(T_last_scan, motions[0]), jnp.zeros(len(scales))
            gap, weight = gaps(here, T)
            slopes, _ = jax.jacfwd(gaps, has_aux=True)(here, T)
            return gap_equations(gap, weight, slopes)

        def score(motions: Float[Array, "1 4 4"]) -> Float[Array, ""]:
            return self.score(rigid.compose(T_last_scan, motions[0]), tolerance)

        motions = improve_motions(equations, score, scales, count=1, num_iterations=_NUM_ITERATIONS)
        return rigid.compose(T_last_scan, motions[0])


def _distinct(
    T: Float[Array, "m 4 4"], scores: Float[Array, " m"], count: int, shares: tuple[float, float]
) -> Float[Array, "k 4 4"]:
    """Selects the best motions that differ by these shares of the largest translation or turn from better ones."""
    far, turn = shares[0] * MAX_TRANSLATION, shares[1] * np.deg2rad(MAX_TURN_DEG)

    def pick(left: Float[Array, " m"], _: None) -> tuple[Float[Array, " m"], Array]:
        best = T[jnp.argmax(left)]
        turned = _turn_of(rigid.compose(rigid.inverse(best), T))
        is_near = (jnp.linalg.norm(T[:, :3, 3] - best[:3, 3], axis=-1) < far) & (turned < turn)
        return jnp.where(is_near, -jnp.inf, left), best

    return jax.lax.scan(pick, scores, length=count)[1]


def _slid(T: Float[Array, "k 4 4"], directions: Float[Array, "a 3"]) -> Float[Array, "m 4 4"]:
    """Returns the motions, and each motion shifted along each axis of the image in both directions."""
    lengths = _SLIDE * MAX_TRANSLATION * jnp.linspace(-1.0, 1.0, _NUM_SLIDES)
    moves = (lengths[:, None, None] * directions).reshape(-1, 3)
    T_scan_slid = jnp.tile(jnp.eye(4), (len(moves), 1, 1)).at[:, :3, 3].set(moves)
    slid = rigid.compose(T[:, None], T_scan_slid).reshape(-1, 4, 4)
    return jnp.concatenate([T, slid])


@partial(jax.jit, static_argnames="config")
def _search(
    references: References,
    view: Views,
    directions: Float[Array, "a 3"],
    camera: SearchCamera,
    key: jax.Array,
    *,
    config: DepthSearchConfig,
) -> Float[Array, "k 4 4"]:
    """Searches the best distinct T_last_scan of the image."""
    turn, tilt, far = np.deg2rad(MAX_TURN_DEG), np.deg2rad(_MAX_TILT_DEG), MAX_TRANSLATION
    widths = jnp.array([far, far, turn] if config.motion == "planar" else [far, far, far, tilt, turn, tilt])
    first_key, round_key = jax.random.split(key)
    values = widths * jax.random.uniform(first_key, (config.num_candidates, len(widths)), minval=-1.0, maxval=1.0)
    T = motion_matrices(values.at[0].set(0.0))
    tolerances = jnp.geomspace(*config.scales.tolerance, _NUM_ROUNDS + _NUM_TOLERANCES)
    comparison = _Comparison(references, view, camera, config)
    nearest = comparison._replace(references=_take(references, slice(_NUM_REFERENCES)))
    for step in range(_NUM_ROUNDS - 1):
        best = T[jax.lax.top_k(nearest.scores(T, tolerances[step]), _NUM_KEPT)[1]]
        noise = jax.random.normal(jax.random.fold_in(round_key, step), (config.num_varied, len(best), len(widths)))
        # The kept motions themselves are candidates of the next round.
        spread = _FIRST_SPREAD * 0.5**step * widths
        moves = motion_matrices((spread * noise.at[0].set(0.0)).reshape(-1, len(widths)))
        T = rigid.compose(best, moves.reshape(config.num_varied, len(best), 4, 4)).reshape(-1, 4, 4)
    scores = nearest.scores(T, tolerances[_NUM_ROUNDS - 1])
    T = _slid(_distinct(T, scores, _NUM_SLID, _DIFFERENT), directions)
    adjusted_at = tolerances[_NUM_ROUNDS:]
    T = _distinct(T, comparison.scores(T, adjusted_at[0]), _NUM_ADJUSTED, _SLID_APART)
    for tolerance in adjusted_at:
        T = jax.lax.map(partial(comparison.adjusted, tolerance=tolerance), T, batch_size=16)
    return _distinct(T, comparison.scores(T, adjusted_at[-1]), _NUM_DISTINCT, _SLID_APART)

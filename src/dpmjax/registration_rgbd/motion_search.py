"""The motions by which a depth image may follow earlier ones: a search of the largest projective consistency.

Motions are drawn and varied from coarse to fine against the last images. An image of a wall hardly depends on the
motion along the wall: the best motions that differ are slid along the surfaces of the image. The best of those are
adjusted against more images, and many that differ are proposed: what this image leaves open, later ones decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.geometry.normals import image_normals
from dpmjax.geometry.se3 import Motion, motion_matrices
from dpmjax.registration_rgbd.adjustment import gap_equations, improve_motions, motion_scales
from dpmjax.registration_rgbd.depth_images import DepthScans, Pinhole, PixelSample
from dpmjax.registration_rgbd.projective_consistency import Agreement, both_ways, surface_gap

# Largest translation between neighbouring images along each axis, metres.
MAX_TRANSLATION = 0.7
# Largest turn between neighbouring images about the vertical axis of the camera, and largest tilt (turn about a
# horizontal axis; full motion only), degrees.
MAX_TURN_DEG, _MAX_TILT_DEG = 75.0, 30.0
# Best motions that go on to the next round, before the slides. Adjusted motions that differ, by which a trajectory is
# continued: where an image leaves open how far the camera moved along a wall, they lie side by side along it.
_NUM_KEPT, _NUM_DISTINCT = 32, 16
# Rounds of motions, each varied half as widely as the one before.
_NUM_ROUNDS = 4
# Best motions of the last round that differ and are slid; places of each along each direction of the surfaces; best
# motions after the slides that differ and are adjusted.
_NUM_SLID, _NUM_SLIDES, _NUM_ADJUSTED = 8, 51, 32
# Earlier images that an image is compared to before the slides, and from the slides on.
_NUM_REFERENCES, _NUM_CHECKED = 4, 8
# Motions differ by such shares of the largest translation and turn: those that are slid, and those that are kept then.
_DIFFERENT, _SLID_APART = (0.35, 0.1), (0.12, 0.06)
# Motions are slid by this number of largest translations, and may then be as long as the second number of them.
_SLIDE, _LONGEST = 1.4, 1.5
# Width of the first variations in shares of the limits; halved from round to round.
_FIRST_SPREAD = 0.25
# Number of tolerances of an adjustment, and of steps at each.
_NUM_TOLERANCES, _NUM_ITERATIONS = 4, 2


@dataclass(frozen=True)
class DepthSearchConfig:
    """Settings of the search.

    Attributes:
        motion: degrees of freedom of the camera.
        num_trajectories: the largest number of trajectories that go on from image to image.
        num_candidates: number of motions of the first round, spread evenly.
        num_varied: number of new motions around each kept one in a round.
        tolerance: share of the depth by which matching points may differ, in the first and in the last round; the last
            one also while trajectories grow.
        final_tolerance: the same, in the last adjustment and where the best trajectory is chosen.
        translation_weight: cost of the largest translation, in matching points. Along a bare wall only this cost
            chooses how far the camera has moved: the shortest translation.
        turn_weight: cost of the largest turn, in matching points.
    """

    motion: Motion = "planar"
    num_trajectories: int = 16
    num_candidates: int = 1024
    num_varied: int = 20
    tolerance: tuple[float, float] = (0.12, 0.02)
    final_tolerance: float = 0.006
    translation_weight: float = 0.05
    turn_weight: float = 0.0

    def __post_init__(self) -> None:
        if min(self.num_trajectories, self.num_candidates, self.num_varied) < 1:
            raise ValueError(f"all counts must be at least 1, got {self}")


def depth_search(motion: Motion) -> DepthSearchConfig:
    """Returns the settings of the search for first poses.

    Args:
        motion: "planar": a level camera on wheels. "full": a hand-held camera, with six numbers to search instead of
            three, small moves between images, and the noise of a real sensor.

    Returns:
        The settings.
    """
    if motion == "planar":
        return DepthSearchConfig()
    return DepthSearchConfig(
        motion="full",
        num_trajectories=8,
        num_candidates=16384,
        num_varied=48,
        tolerance=(0.12, 0.03),
        final_tolerance=0.015,
        translation_weight=0.2,
        turn_weight=0.3,
    )


class SearchCamera(NamedTuple):
    """The camera of all images, and their typical range in the unit of the points."""

    pinhole: Pinhole
    unit: Float[Array, ""] | float


class Views(NamedTuple):
    """Images as the search sees them; of one image without the leading axis.

    Attributes:
        sample: (r, p, 3) points of each.
        surfaces: (r, 4, h - 1, w - 1) their surfaces, as `image_surface` has them.
        directions: (r, a, 3) axes of the surfaces in the camera frame, that along which the surfaces hold least first.
    """

    sample: PixelSample
    surfaces: Float[Array, "... 4 r c"]
    directions: Float[Array, "... a 3"]


class References(NamedTuple):
    """Earlier images that an image is compared to, the last one first.

    Attributes:
        T_last_reference: poses in the frame of the last image.
        weights: 0 for images that are not there.
        views: the images.
    """

    T_last_reference: Float[Array, "r 4 4"]
    weights: Float[Array, " r"]
    views: Views


def surface_directions(scans: DepthScans, motion: Motion) -> NDArray[np.float32]:
    """Directions in which the surfaces of an image hold the camera, from the least to the most.

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
    camera: SearchCamera,
    config: DepthSearchConfig,
    *,
    key: jax.Array,
) -> NDArray[np.float64]:
    """Returns the best motions of the next image that differ.

    Args:
        T_world_camera: (m, 4, 4) poses of the images before it.
        views: all images, n > m.
        camera: camera of the images.
        config: settings of the search.
        key: key of the search.

    Returns:
        (k, 4, 4) T_last_next, the best one first.
    """
    scan, num_scans = len(T_world_camera), views.surfaces.shape[0]
    num_checked = min(max(_NUM_REFERENCES, _NUM_CHECKED), num_scans - 1)
    # A window of fixed length: where there are fewer images before, the first is repeated without weight.
    before = scan - 1 - np.arange(num_checked)
    rows = np.maximum(before, 0)
    references = References(
        jnp.asarray(np.linalg.inv(T_world_camera[-1]) @ T_world_camera[rows], jnp.float32),
        jnp.asarray(before >= 0, jnp.float32),
        _take(views, rows),
    )
    found = _search(references, _take(views, scan), camera, key, config=config)
    return np.asarray(found, np.float64)


def motion_cost(length: Any, turn: Any, config: DepthSearchConfig) -> Any:
    """Returns the costs of motions, in consistency: the shortest motion is taken where images leave it open.

    Args:
        length: length of motions between neighbouring images, unit of the points.
        turn: their angles, radians.
        config: settings of the search.

    Returns:
        The cost of each.
    """
    turn_share = turn / np.deg2rad(MAX_TURN_DEG)
    return config.translation_weight * length / MAX_TRANSLATION + config.turn_weight * turn_share


def _take(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def _turn_of(T: Float[Array, "... 4 4"]) -> Float[Array, "..."]:
    """Angle of a motion, radians."""
    return jnp.arccos(jnp.clip(0.5 * (jnp.trace(T[..., :3, :3], axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))


def _score_motion(
    T_last_scan: Float[Array, "4 4"],
    references: References,
    view: Views,
    pinhole: Pinhole,
    tolerance: Array,
    config: DepthSearchConfig,
) -> Float[Array, ""]:
    """Consistency of an image with its references at a motion, less the cost of the motion."""

    def against(T_last_ref: Array, reference: Views) -> Agreement:
        T_ref_scan = rigid.compose(rigid.inverse(T_last_ref), T_last_scan)
        samples, surfaces = (view.sample, reference.sample), (view.surfaces, reference.surfaces)
        return both_ways(T_ref_scan, samples, surfaces, pinhole, tolerance)

    agreements = jax.vmap(against)(references.T_last_reference, references.views)
    agreement = Agreement(*(references.weights * values for values in agreements))
    length = jnp.linalg.norm(T_last_scan[:3, 3])
    score = agreement.consistency() - motion_cost(length, _turn_of(T_last_scan), config)
    return jnp.where(length > _LONGEST * MAX_TRANSLATION, -jnp.inf, score)


def _distinct(
    T: Float[Array, "m 4 4"],
    scores: Float[Array, " m"],
    count: int,
    shares: tuple[float, float],
) -> Float[Array, "k 4 4"]:
    """The best motions that differ by these shares of the largest translation or turn from all better ones."""
    far, turn = shares[0] * MAX_TRANSLATION, shares[1] * np.deg2rad(MAX_TURN_DEG)

    def pick(left: Float[Array, " m"], _: None) -> tuple[Float[Array, " m"], Array]:
        best = T[jnp.argmax(left)]
        turned = _turn_of(rigid.compose(rigid.inverse(best), T))
        is_near = (jnp.linalg.norm(T[:, :3, 3] - best[:3, 3], axis=-1) < far) & (turned < turn)
        return jnp.where(is_near, -jnp.inf, left), best

    return jax.lax.scan(pick, scores, length=count)[1]


def _slid(T: Float[Array, "k 4 4"], directions: Float[Array, "a 3"]) -> Float[Array, "m 4 4"]:
    """The motions, each moved to and fro along each axis of the image."""
    lengths = _SLIDE * MAX_TRANSLATION * jnp.linspace(-1.0, 1.0, _NUM_SLIDES)
    moves = (lengths[:, None, None] * directions).reshape(-1, 3)
    T_scan_slid = jnp.tile(jnp.eye(4), (len(moves), 1, 1)).at[:, :3, 3].set(moves)
    slid = rigid.compose(T[:, None], T_scan_slid).reshape(-1, 4, 4)
    return jnp.concatenate([T, slid])


def _adjusted(
    T_last_scan: Float[Array, "4 4"],
    references: References,
    view: Views,
    camera: SearchCamera,
    tolerance: Float[Array, ""],
    config: DepthSearchConfig,
) -> Float[Array, "4 4"]:
    """A motion so that points of the image lie on the surfaces of its references, and theirs on its own."""
    pinhole = camera.pinhole
    scales = motion_scales(config.motion, camera.unit, tolerance)

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
        return _score_motion(rigid.compose(T_last_scan, motions[0]), references, view, pinhole, tolerance, config)

    motions = improve_motions(equations, score, scales, count=1, num_iterations=_NUM_ITERATIONS)
    return rigid.compose(T_last_scan, motions[0])


@partial(jax.jit, static_argnames="config")
def _search(
    references: References,
    view: Views,
    camera: SearchCamera,
    key: jax.Array,
    *,
    config: DepthSearchConfig,
) -> Float[Array, "k 4 4"]:
    """The best T_last_scan of the image that differ."""
    turn, tilt, far = np.deg2rad(MAX_TURN_DEG), np.deg2rad(_MAX_TILT_DEG), MAX_TRANSLATION
    widths = jnp.array([far, far, turn] if config.motion == "planar" else [far, far, far, tilt, turn, tilt])
    first_key, round_key = jax.random.split(key)
    values = widths * jax.random.uniform(first_key, (config.num_candidates, len(widths)), minval=-1.0, maxval=1.0)
    T = motion_matrices(values.at[0].set(0.0))
    tolerances = jnp.geomspace(*config.tolerance, _NUM_ROUNDS + _NUM_TOLERANCES)
    nearest = _take(references, slice(_NUM_REFERENCES))

    def scores_of(T: Float[Array, "m 4 4"], compared: References, tolerance: Float[Array, ""]) -> Float[Array, " m"]:
        return jax.lax.map(
            lambda one: _score_motion(one, compared, view, camera.pinhole, tolerance, config), T, batch_size=128
        )

    for step in range(_NUM_ROUNDS - 1):
        best = T[jax.lax.top_k(scores_of(T, nearest, tolerances[step]), _NUM_KEPT)[1]]
        noise = jax.random.normal(jax.random.fold_in(round_key, step), (config.num_varied, len(best), len(widths)))
        # The kept motions themselves are candidates of the next round.
        spread = _FIRST_SPREAD * 0.5**step * widths
        moves = motion_matrices((spread * noise.at[0].set(0.0)).reshape(-1, len(widths)))
        T = rigid.compose(best, moves.reshape(config.num_varied, len(best), 4, 4)).reshape(-1, 4, 4)
    scores = scores_of(T, nearest, tolerances[_NUM_ROUNDS - 1])
    T = _slid(_distinct(T, scores, _NUM_SLID, _DIFFERENT), view.directions)
    adjusted_at = tolerances[_NUM_ROUNDS:]
    T = _distinct(T, scores_of(T, references, adjusted_at[0]), _NUM_ADJUSTED, _SLID_APART)
    for tolerance in adjusted_at:

        def adjust(one: Float[Array, "4 4"], tolerance: Float[Array, ""] = tolerance) -> Float[Array, "4 4"]:
            return _adjusted(one, references, view, camera, tolerance, config)

        T = jax.lax.map(adjust, T, batch_size=16)
    return _distinct(T, scores_of(T, references, adjusted_at[-1]), _NUM_DISTINCT, _SLID_APART)

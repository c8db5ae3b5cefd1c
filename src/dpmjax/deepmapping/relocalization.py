"""Re-localisation of scans that a fit has not seen: L-Net proposes poses, M-Net chooses (DeepMapping figure 7).

L-Net knows the headings of the walk only. So each scan is turned all round, L-Net proposes a pose for every turn, and
the one stays around which the map of M-Net explains the scan best. What the map explains badly was never seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import require_count
from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.localization_training import has_windows, turn_scan
from dpmjax.deepmapping.map_raster import make_raster
from dpmjax.deepmapping.map_search import MapSearchConfig, map_fields, search_map
from dpmjax.deepmapping.planar import Fitted, as_scan_set, choose_beams, localize_scans
from dpmjax.geometry import se2
from dpmjax.types import ScanSet

# Scans that L-Net sees at once where there are many.
_CHUNK = 1024


class Relocalized(NamedTuple):
    """Poses of scans in the world of a fit.

    Attributes:
        pose: (3,) or (m, 3) x, y, heading in (-pi, pi], unit of the points.
        nats: () or (m,) what a beam costs by the map at this pose: 0 where M-Net explains it fully, log 4 where it
            knows nothing.
        is_known: () or (m,) False where the map does not explain the scan: its view was never seen, or the pose is
            wrong.
    """

    pose: NDArray[np.float64]
    nats: NDArray[np.float64]
    is_known: NDArray[np.bool_]

    @property
    def T_world_scan(self) -> NDArray[np.float64]:
        """(3, 3), or (m, 3, 3) for m scans: the poses as matrices."""
        return se2.to_matrix(self.pose)


@dataclass(frozen=True)
class RelocalizationConfig:
    """Settings of `relocalize`.

    Attributes:
        num_turns: headings at which L-Net sees each scan, evenly all round.
        max_nats: a scan whose beams cost more is not known.
        search: settings of the search around L-Net's proposals.
    """

    num_turns: int = 24
    max_nats: float = 0.4
    search: MapSearchConfig = field(default_factory=MapSearchConfig)

    def __post_init__(self) -> None:
        require_count("num_turns", self.num_turns)
        if not self.max_nats > 0.0:
            raise ValueError(f"max_nats: expected a positive number, got {self.max_nats}")


def relocalize(fitted: Fitted, scan: ScanSet | ArrayLike, config: RelocalizationConfig | None = None) -> Relocalized:
    """Estimates poses of new scans, and tells which of them the fit does not know (DeepMapping section 4.1, figure 7).

    Nothing is assumed about the heading. L-Net proposes a pose for each of several turns of the scan; a search around
    the proposals takes the pose at which M-Net explains the scan best. After the free poses of the fast preset L-Net
    lags behind the poses; `train_localization` brings it back to them.

    Args:
        fitted: result of `fit_deepmapping` from zero poses with one L-Net for all scans, or of `train_localization`;
            M-Net must have been trained, as all presets do, or no scan is known.
        scan: (b, 2) one scan, or (m, b, 2), in the sensor frame, unit and order of the beams as in the fit; beams with
            coordinates that are not finite, or both zero, measured nothing.
        config: settings.

    Returns:
        Relocalized, in the world of the fit's own poses.

    Raises:
        ValueError: the shape is another one, a scan has no valid beam, each window of the fit has an L-Net of its own,
            or L-Net's outputs are corrections of given start poses.
    """
    config = config or RelocalizationConfig()
    if has_windows(fitted):
        raise ValueError("fitted: each of its L-Nets knows one window of the walk; call train_localization first")
    if np.any(np.asarray(fitted.params.start) != 0.0):
        raise ValueError(
            "fitted: its L-Net corrects given start poses, which a new scan has not; call train_localization first"
        )
    is_one = not isinstance(scan, ScanSet) and np.ndim(scan) == 2
    scans = as_scan_set(np.asarray(scan)[None] if is_one else scan, min_scans=1)
    fields = map_fields(make_raster(fitted.params, fitted.config), config=config.search)
    parts = []
    for k in range(0, len(scans.points), _CHUNK):
        part = ScanSet(scans.points[k : k + _CHUNK] / fitted.unit, scans.mask[k : k + _CHUNK])
        turned = partial(propose_poses, fitted.params.localization, part, num_turns=config.num_turns)
        parts.append(search_map(part, turned(fit_config=fitted.config), fields, config=config.search))
    poses, nats = (np.concatenate([np.asarray(x, np.float64) for x in each]) for each in zip(*parts, strict=True))
    poses[:, :2] *= fitted.unit
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    found = Relocalized(poses, nats, nats <= config.max_nats)
    return Relocalized(*(x[0] for x in found)) if is_one else found


@partial(jax.jit, static_argnames=("num_turns", "fit_config"))
def propose_poses(
    params: Any, scans: ScanSet, *, num_turns: int, fit_config: DeepMappingConfig
) -> Float[Array, "m t 3"]:
    """L-Net's poses of scans, one for each turn of the scan.

    Args:
        params: weights of L-Net.
        scans: (m, b, 2) in typical ranges.
        num_turns: evenly all round; the first is none.
        fit_config: settings of the fit.

    Returns:
        x, y, heading of the scans as they are, in typical ranges and radians.
    """
    beams = choose_beams(scans.mask.shape[1], fit_config.cold_phases[0])
    mask, turns = scans.mask[:, beams], 2.0 * jnp.pi * jnp.arange(num_turns) / num_turns

    def propose(turn: Float[Array, ""]) -> Float[Array, "m 3"]:
        points = jax.vmap(turn_scan, in_axes=(0, None))(scans.points[:, beams], turn)
        found = localize_scans(params, points, mask, fit_config)
        return found - turn * jnp.array([0.0, 0.0, 1.0])

    return jnp.swapaxes(jax.lax.map(propose, turns), 0, 1)

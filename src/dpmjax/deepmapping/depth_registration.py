"""Registration of depth images by one call: the search for first poses, DeepMapping from them, the better of both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.depth import DepthFitted, as_depth_scans, fit_depth
from dpmjax.deepmapping.depth_config import DepthMappingConfig
from dpmjax.deepmapping.depth_initialization import initialize_depth
from dpmjax.deepmapping.engine import Fit, fit
from dpmjax.deepmapping.projective_consistency import DepthScans, projective_consistency


class RegisteredDepth(NamedTuple):
    """Result of `register_depth`.

    Attributes:
        T_world_camera: (n, 4, 4) float64, unit of the points: of the fit, or the start where that agrees better.
        kept: source of the poses, the fit or the start.
        consistency: projective consistency of the fit, at most 1.
        start_consistency: the same of the start.
        start: (n, 4, 4) poses that the fit started from.
        fitted: DeepMapping of the images.
    """

    T_world_camera: NDArray[np.float64]
    kept: Literal["fit", "start"]
    consistency: float
    start_consistency: float
    start: NDArray[np.float64]
    fitted: DepthFitted


def register_depth(
    images: DepthScans | ArrayLike,
    config: DepthMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | None = None,
    engine: Callable[..., Fit] = fit,
) -> RegisteredDepth:
    """Registers depth images: a search for first poses, DeepMapping from them (section 4.2), and of both the better.

    They are compared by `projective_consistency`, without ground truth.

    Args:
        images: (n, h, w, 3) points in the camera frames (x right, y down, z forward), any unit; or DepthScans.
        config: settings of the fit; None: `depth_preset("fast")`. Its `motion` holds for the search, too.
        key: of the search and of the fit.
        start: (n, 4, 4) T_world_camera to start from; None: `initialize_depth` searches first poses.
        engine: of the fit, as in `fit_depth`.

    Returns:
        RegisteredDepth, in the world of the start.

    Raises:
        ValueError: as `as_depth_scans`, or `start` has a wrong shape or is not finite.
    """
    config = config or DepthMappingConfig()
    scans = images if isinstance(images, DepthScans) else as_depth_scans(images)
    if start is None:
        start = initialize_depth(scans, motion=config.motion, key=key)
    # Search and fit share the key: a fit from given poses gives the same as one from the same poses, found here. The
    # published numbers rest on it.
    fitted = fit_depth(scans, config, key=key, start=start, engine=engine)
    T_start = np.asarray(start, np.float64)
    consistency, start_consistency = (float(projective_consistency(scans, T)) for T in (fitted.T_world_camera, T_start))
    # A fit that is not finite is not better.
    if consistency >= start_consistency:
        return RegisteredDepth(fitted.T_world_camera, "fit", consistency, start_consistency, T_start, fitted)
    return RegisteredDepth(T_start, "start", consistency, start_consistency, T_start, fitted)

"""Rays between the sensor and what it hit: samples of free space on them, and their typical length."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_float, as_points, require_shape
from dpmjax.types import AnyArray


def sample_free_space(
    origin: Float[AnyArray, " d"], points: Float[AnyArray, "b d"], factors: Float[AnyArray, "*beams s"]
) -> Float[Array, "b s d"]:
    """Points on the segments from the sensor to its hits (DeepMapping section 3.2, figure 3).

    Args:
        origin: the sensor's centre, in the frame and unit of `points`.
        points: where the beams end.
        factors: fractions of the segments, in (0, 1), either (s,) shared by all beams or (b, s) for each beam.

    Returns:
        `origin + factor * (point - origin)` for every beam and factor.

    Raises:
        ValueError: the shapes do not match.
    """
    points = as_points("points", points)
    origin, factors = as_float("origin", origin), as_float("factors", factors)
    num_beams, dim = points.shape
    require_shape("origin", origin, (dim,))
    if factors.ndim not in (1, 2) or (factors.ndim == 2 and factors.shape[0] != num_beams):
        raise ValueError(f"factors: expected shape (s,) or ({num_beams}, s), got {factors.shape}")
    return origin + factors[..., None] * (points - origin)[:, None, :]


def typical_range(points: Float[AnyArray, "n *beams d"], mask: Bool[AnyArray, "n *beams"]) -> float:
    """The range that nine beams in ten of a scan stay below, median over the scans: the unit of length of a fit.

    Args:
        points: beam end points of n scans in their sensor frames, any unit; planar scans or depth images.
        mask: False for beams that measured nothing; they may hold anything.

    Returns:
        The range, in the unit of the points. Scans without a valid beam are left out; 1 if no scan has one.
    """
    ranges = np.linalg.norm(np.asarray(points, np.float32), axis=-1)
    far = [np.percentile(r[m], 90) for r, m in zip(ranges, np.asarray(mask), strict=True) if m.any()]
    return float(np.median(far)) if far else 1.0

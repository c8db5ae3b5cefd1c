"""Beams of a range sensor: samples of the free space on them, and how far they typically reach."""

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


def typical_range(points: Float[AnyArray, "n b d"], mask: Bool[AnyArray, "n b"]) -> float:
    """The range that nine beams in ten of a scan stay below, as the median over the scans.

    Args:
        points: beam end points, each scan in its own sensor frame.
        mask: True where a beam measured something; scans without any do not count.

    Returns:
        The range, in the unit of the points.

    Raises:
        ValueError: no beam measured anything.
    """
    ranges, mask = np.linalg.norm(np.asarray(points), axis=-1), np.asarray(mask)
    of_scans = [
        np.percentile(beams[is_valid], 90) for beams, is_valid in zip(ranges, mask, strict=True) if is_valid.any()
    ]
    if not of_scans:
        raise ValueError("mask: expected at least one valid beam, got none")
    return float(np.median(of_scans))

"""How the arrays of compact scans are stored at each precision: exactly, or as codes of few bytes.

At int8, features are written in the basis of their principal components (few carry nearly all), and all coefficients
are rounded to one step. Points are rounded to centimetres and stored as differences along their space-filling curve,
so that the compression of the file finds small numbers.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int8, Int16, UInt8
from numpy.typing import NDArray

from dpmjax.scans.compact import MAX_COMPONENT, MAX_COORDINATE, CompactSurface, compact_surface, expand_surface

Precision = Literal["float32", "float16", "int8"]

MAX_RANK = 48
STEP_SHARE = 0.5
"""Step of the coefficients, as a share of the standard deviation of a channel."""

POINT_STEP_M, POSITION_STEP_M = 0.02, 0.05
MAX_STORED_POINTS = 2000
FLATNESS_STEP = 17
MAX_CODE = np.iinfo(np.int8).max


class FeatureCodes(NamedTuple):
    """Features as coefficients of principal components: `mean + step * codes @ basis`.

    Attributes:
        mean: of the features.
        basis: (r, c) principal components.
        step: of the coefficients.
        codes: (r, d) of all descriptors, one component after the other.
    """

    mean: Float[np.ndarray, " c"]
    basis: Float[np.ndarray, "r c"]
    step: float
    codes: Int8[np.ndarray, "r d"]


def encode_features(features: Float[np.ndarray, "d c"]) -> FeatureCodes:
    """Rounds features to codes.

    Args:
        features: of all descriptors of a map.

    Returns:
        The codes.
    """
    mean = features.mean(axis=0, dtype=np.float64) if len(features) else np.zeros(features.shape[1])
    centred = features - mean
    variances, axes = np.linalg.eigh(centred.T @ centred / max(len(features), 1))
    basis = axes[:, ::-1][:, :MAX_RANK].T
    coefficients = basis @ centred.T
    step = max(
        STEP_SHARE * float(np.sqrt(max(variances.mean(), 0))), float(np.abs(coefficients).max(initial=0)) / MAX_CODE
    )
    step = max(step, 1e-12)
    codes = np.rint(coefficients / step).astype(np.int8)
    is_used = codes.any(axis=1)
    return FeatureCodes(mean.astype(np.float32), basis[is_used].astype(np.float16), step, codes[is_used])


def decode_features(stored: FeatureCodes) -> Float[np.ndarray, "d c"]:
    """Makes the features again.

    Args:
        stored: from `encode_features`.

    Returns:
        float32.
    """
    return (stored.codes.T.astype(np.float32) * np.float32(stored.step)) @ stored.basis.astype(np.float32) + stored.mean


class SurfaceCodes(NamedTuple):
    """The surface points of a scan as codes.

    Attributes:
        unit_m: what 1 stands for in `steps`.
        steps: (3, n) differences of rounded coordinates along the curve; the first stands for itself.
        normals: (2, n) octahedral coordinates times 127 (Meyer et al. 2010), of the side that looks up.
        flatness: (n,) from 0 to 15.
    """

    unit_m: float
    steps: Int16[np.ndarray, "3 n"]
    normals: Int8[np.ndarray, "2 n"]
    flatness: UInt8[np.ndarray, " n"]


def encode_surface(surface: CompactSurface) -> SurfaceCodes:
    """Thins a compact surface again, and rounds it to codes.

    Args:
        surface: of a keyframe.

    Returns:
        The codes.
    """
    if len(surface.points) > MAX_STORED_POINTS:
        surface = compact_surface(expand_surface(surface), MAX_STORED_POINTS)
    unit_m = max(POINT_STEP_M, surface.unit_m * 2)  # differences of two coordinates fit 16 bits
    rounded = np.rint(surface.points.T * (surface.unit_m / unit_m)).astype(np.int32)
    steps = np.diff(rounded, axis=1, prepend=0).astype(np.int16)
    flatness = np.rint(surface.flatness / FLATNESS_STEP).astype(np.uint8)
    return SurfaceCodes(unit_m, steps, _octahedral(surface.normals), flatness)


def decode_surface(stored: SurfaceCodes) -> CompactSurface:
    """Makes the compact surface again.

    Args:
        stored: from `encode_surface`.

    Returns:
        The surface.
    """
    rounded = np.clip(np.cumsum(stored.steps, axis=1, dtype=np.int64), -MAX_COORDINATE, MAX_COORDINATE)
    flatness = np.minimum(stored.flatness.astype(np.int64) * FLATNESS_STEP, 255).astype(np.uint8)
    return CompactSurface(stored.unit_m, rounded.T.astype(np.int16), _from_octahedral(stored.normals), flatness)


def _octahedral(normals: Int8[np.ndarray, "n 3"]) -> Int8[np.ndarray, "2 n"]:
    upward = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    flat = upward[:, :2] / np.maximum(np.abs(upward).sum(axis=1, keepdims=True), 1)
    return np.rint(flat.T * MAX_COMPONENT).astype(np.int8)


def _from_octahedral(stored: Int8[np.ndarray, "2 n"]) -> Int8[np.ndarray, "n 3"]:
    flat = stored.astype(np.float64) / MAX_COMPONENT
    normals = np.column_stack([*flat, np.maximum(1 - np.abs(flat).sum(axis=0), 0)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.rint(normals * MAX_COMPONENT).astype(np.int8)


def encode_directions(directions: Float[np.ndarray, "*d 2"]) -> Int8[np.ndarray, "*d"]:
    """Rounds horizontal directions to angles 1.4 degrees apart.

    Args:
        directions: unit vectors.

    Returns:
        Their azimuths, pi as 127.
    """
    return np.rint(np.arctan2(directions[..., 1], directions[..., 0]) * (MAX_CODE / np.pi)).astype(np.int8)


def decode_directions(codes: Int8[np.ndarray, "*d"]) -> Float[np.ndarray, "*d 2"]:
    """Makes unit vectors again.

    Args:
        codes: from `encode_directions`.

    Returns:
        The directions, float32.
    """
    angles = codes.astype(np.float64) * (np.pi / MAX_CODE)
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32)


def rounded_to(values: Float[np.ndarray, "..."], step: float) -> NDArray[Any]:
    """Rounds to multiples of a step, as 16-bit integers.

    Args:
        values: within 32,767 steps of 0.
        step: the step.

    Returns:
        The integers.
    """
    return np.clip(np.rint(values / step), -MAX_COORDINATE, MAX_COORDINATE).astype(np.int16)

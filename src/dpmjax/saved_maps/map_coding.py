"""Codes of few bytes for the smallest maps.

Features are written in the basis of their principal components (few carry nearly all), and all coefficients are rounded
to one step. Surface elements are rounded to centimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int8, Int16, UInt8

from dpmjax.scans.compact import MAX_COMPONENT, CompactElements

Precision = Literal["float32", "int8"]

MAX_RANK = 16
"""Largest number of principal components."""

STEP_SHARE = 0.7
"""Step of the coefficients, as a share of the standard deviation of a channel."""

NUM_ELEMENTS = 256
"""Number of surface elements of a keyframe, if it has no more descriptors: localisation needs keyframes more."""

POSITION_STEP_M = 0.02
PLANARITY_STEP = 17
MAX_CODE = np.iinfo(np.int8).max


class FeatureCodes(NamedTuple):
    """Features as coefficients of principal components: `mean + step * codes @ basis`.

    Attributes:
        mean: mean of the features.
        basis: (r, c) principal components.
        step: step of the coefficients.
        codes: (r, d) of all descriptors, component by component.
    """

    mean: Float[np.ndarray, " c"]
    basis: Float[np.ndarray, "r c"]
    step: float
    codes: Int8[np.ndarray, "r d"]


def encode_features(features: Float[np.ndarray, "d c"]) -> FeatureCodes:
    """Rounds features to codes.

    Args:
        features: features of all descriptors of a map.

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
        stored: result of `encode_features`.

    Returns:
        float32.
    """
    return (stored.codes.T.astype(np.float32) * np.float32(stored.step)) @ stored.basis.astype(np.float32) + stored.mean


class ElementCodes(NamedTuple):
    """Surface elements of keyframes as codes.

    Attributes:
        positions: (k, 3, n) in steps of 2 cm.
        normals: (k, 2, n) octahedral coordinates times 127 (Meyer et al. 2010), of the side that looks up.
        planarity: (k, n) from 0 to 15.
        mask: (k, n) True for elements that are there.
    """

    positions: Int16[np.ndarray, "k 3 n"]
    normals: Int8[np.ndarray, "k 2 n"]
    planarity: UInt8[np.ndarray, "k n"]
    mask: Bool[np.ndarray, "k n"]


def encode_elements(keyframes: Sequence[CompactElements]) -> ElementCodes:
    """Rounds surface elements to codes.

    Args:
        keyframes: keyframes of one number of elements.

    Returns:
        The codes.
    """
    return ElementCodes(
        np.stack([np.rint(one.positions.T * (one.unit_m / POSITION_STEP_M)) for one in keyframes]).astype(np.int16),
        np.stack([_octahedral(one.normals) for one in keyframes]),
        np.stack([np.rint(one.planarity / PLANARITY_STEP) for one in keyframes]).astype(np.uint8),
        np.stack([one.mask for one in keyframes]),
    )


def decode_elements(stored: ElementCodes) -> list[CompactElements]:
    """Makes the surface elements again.

    Args:
        stored: result of `encode_elements`.

    Returns:
        Elements of each keyframe.
    """
    return [
        CompactElements(
            POSITION_STEP_M,
            positions.T.astype(np.int16),
            np.where(planarity[:, None] > 0, _from_octahedral(normals), 0).astype(np.int8),
            np.minimum(planarity.astype(np.int64) * PLANARITY_STEP, 255).astype(np.uint8),
            mask,
        )
        for positions, normals, planarity, mask in zip(*stored, strict=True)
    ]


def _octahedral(normals: Int8[np.ndarray, "n 3"]) -> Int8[np.ndarray, "2 n"]:
    upward = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    flat = upward[:, :2] / np.maximum(np.abs(upward).sum(axis=1, keepdims=True), 1)
    return np.rint(flat.T * MAX_COMPONENT).astype(np.int8)


def _from_octahedral(stored: Int8[np.ndarray, "2 n"]) -> Int8[np.ndarray, "n 3"]:
    flat = stored.astype(np.float64) / MAX_COMPONENT
    normals = np.column_stack([*flat, np.maximum(1 - np.abs(flat).sum(axis=0), 0)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.rint(normals * MAX_COMPONENT).astype(np.int8)

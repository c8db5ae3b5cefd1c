"""Statistics of preprocessed lidar scans: ranges, heights and shapes of neighbourhoods, and how far two sets differ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dpmjax.scans import PreprocessConfig, preprocess_scan_on_host

RANGE_EDGES_M = np.arange(0.0, 61.0, 2.5)
HEIGHT_EDGES_M = np.r_[-np.inf, np.arange(-4.0, 12.1, 0.5), np.inf]
SHAPE_EDGES = np.linspace(0.0, 1.0, 21)
NUM_NEIGHBOURS = 16
_FEW = 30
HISTOGRAMS = ("range", "height", "linearity", "planarity", "scattering")


@dataclass(frozen=True)
class ScanStatistics:
    """Means over the scans of a set; every scan counts the same.

    Attributes:
        points: number of points after preprocessing.
        far: share beyond 20 m.
        low: share below -1.4 m in the frame of the lidar.
        high: share above 1 m.
        linear: share of neighbourhoods that are lines: linearity is the largest of the three features.
        planar: share that are planes.
        volumetric: share that are volumes.
        histograms: shares of the points, for each name in `HISTOGRAMS`.
    """

    points: float
    far: float
    low: float
    high: float
    linear: float
    planar: float
    volumetric: float
    histograms: dict[str, NDArray[np.float64]]


def scan_statistics(scans: Iterable[NDArray[np.float32]]) -> ScanStatistics:
    """Preprocesses scans as training does and averages what they hold.

    Args:
        scans: raw points (n, 3) of each scan, m, in the frame of the lidar.

    Returns:
        The statistics.

    Raises:
        ValueError: no scan has more than a handful of points.
    """
    config = PreprocessConfig()
    rows, histograms = [], []
    for raw in scans:
        cloud = preprocess_scan_on_host(raw, None, config)
        points = np.asarray(cloud.points)[np.asarray(cloud.mask)]
        if len(points) < _FEW:
            continue
        ranges, heights, shape = np.linalg.norm(points, axis=1), points[:, 2], shape_features(points)
        kinds = np.bincount(shape.argmax(1), minlength=3) / len(shape)
        rows.append([len(points), (ranges > 20).mean(), (heights < -1.4).mean(), (heights > 1).mean(), *kinds])
        values = ((ranges, RANGE_EDGES_M), (heights, HEIGHT_EDGES_M), *((column, SHAPE_EDGES) for column in shape.T))
        histograms.append([np.histogram(x, edges)[0] / len(points) for x, edges in values])
    if not rows:
        raise ValueError(f"scans: expected some with at least {_FEW} points after preprocessing, got none")
    means = {
        name: np.mean(column, axis=0) for name, column in zip(HISTOGRAMS, zip(*histograms, strict=True), strict=True)
    }
    return ScanStatistics(*(float(value) for value in np.mean(rows, axis=0)), histograms=means)


def shape_features(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Linearity, planarity and scattering of the neighbourhood of each point (Demantke et al. 2011, eq. 1).

    Args:
        points: (n, 3), n at least `NUM_NEIGHBOURS`.

    Returns:
        (n, 3), which sum to 1: differences of the standard deviations along the principal axes, over the largest.
    """
    near = cKDTree(points).query(points, NUM_NEIGHBOURS)[1]
    around = points[near].astype(np.float64)
    around -= around.mean(1, keepdims=True)
    variances = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", around, around, optimize=True))[:, ::-1]
    first, second, third = np.sqrt(np.maximum(variances, 0.0)).T
    first = np.maximum(first, 1e-9)
    return np.column_stack([first - second, second - third, third]) / first[:, None]


def histogram_distance(a: ScanStatistics, b: ScanStatistics) -> dict[str, float]:
    """Total variation between the histograms of two sets, by name: 0 where they agree, 1 where they share nothing.

    Args:
        a: one set.
        b: the other.

    Returns:
        One distance a histogram.
    """
    return {name: 0.5 * float(np.abs(a.histograms[name] - b.histograms[name]).sum()) for name in HISTOGRAMS}


def mean_statistics(rows: Sequence[ScanStatistics], weights: Sequence[float] | None = None) -> ScanStatistics:
    """The statistics of several sets together.

    Args:
        rows: one of each set.
        weights: of the sets; None counts them the same.

    Returns:
        Weighted means.
    """
    histograms = {
        name: np.average([row.histograms[name] for row in rows], axis=0, weights=weights) for name in HISTOGRAMS
    }
    numbers = [[row.points, row.far, row.low, row.high, row.linear, row.planar, row.volumetric] for row in rows]
    return ScanStatistics(*(float(x) for x in np.average(numbers, axis=0, weights=weights)), histograms=histograms)

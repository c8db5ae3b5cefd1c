"""Likely turns between scans, from the directions of the visible walls.

The histogram of these directions turns with the scan and does not change under translation along the same walls. So two
histograms are correlated over all turns (angle histograms, Weiss and von Puttkamer 1995). A scan with a limited field
of view misses walls, which lowers the peak of the correct turn and does not shift it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Complex, Float

from dpmjax.scan.planar.record import Floats, Indices, PlanarScans

# Directions of a histogram, and the blur of each direction in units of them.
NUM_DIRECTIONS, _BLUR = 128, 1.0
# The weight of a beam is the root of the length of wall between neighbouring beams, so that neither near nor slanted
# walls dominate; cosines of slanted walls are bounded below.
_LENGTH_POWER, _MIN_COSINE = 0.5, 0.15
# Turns on either side of a peak that belong to it, of NUM_DIRECTIONS; headings that are tried on either side of it.
_PEAK_WIDTH, _TRIED_WIDTH = 6, 2
# Values of curves that are computed at a time: 32 MB.
_BLOCK = 1 << 22


class WallDirections:
    """Histograms of wall directions of n scans.

    Args:
        scans: n scans.
    """

    def __init__(self, scans: PlanarScans) -> None:
        self._spectra = _spectra(scans)

    def similarity(self, source: Indices, target: Indices) -> Floats:
        """Correlates the histograms of pairs.

        Args:
            source: (p,) rows.
            target: (p,) rows.

        Returns:
            (p, 128), -1 to 1; turn k is the heading 2 pi k / 128 of T_target_source. Zero for a scan without walls.
        """
        spectrum = self._spectra[target] * np.conj(self._spectra[source])
        return np.asarray(np.fft.irfft(spectrum, n=NUM_DIRECTIONS, axis=-1), np.float64)

    def best_similarity(self, rows: Indices, others: Indices) -> Float[np.ndarray, "r o"]:
        """Finds the similarity of each pair at its best turn.

        Args:
            rows: (r,) rows.
            others: (o,) rows.

        Returns:
            (r, o) float32, -1 to 1.
        """
        best = np.empty((len(rows), len(others)), np.float32)
        height = max(1, _BLOCK // (NUM_DIRECTIONS * max(len(others), 1)))
        for start in range(0, len(rows), height):
            block = rows[start : start + height]
            first, second = np.repeat(block, len(others)), np.tile(others, len(block))
            best[start : start + height] = self.similarity(first, second).max(-1).reshape(len(block), -1)
        return best

    def most_similar(self, rows: Indices, others: Indices, count: int) -> Indices:
        """Finds the most similar scans of each scan.

        Args:
            rows: (r,) rows.
            others: (o,) rows; a scan is not compared with itself.
            count: largest number of partners.

        Returns:
            (r, k) rows of `others`, the most similar first; k is the lesser of `count` and the number of other scans.
        """
        num_kept = min(count, len(others) - int(np.isin(rows, others).any()))
        similarity = np.where(rows[:, None] == others, -np.inf, self.best_similarity(rows, others))
        return others[np.argsort(-similarity, axis=1, kind="stable")[:, :num_kept]]

    def likely_turns(self, source: Indices, target: Indices, num_turns: int, num_peaks: int) -> Bool[np.ndarray, "p t"]:
        """Chooses the headings of a pair near the peaks of the similarity.

        Args:
            source: (p,) rows.
            target: (p,) rows.
            num_turns: number of headings in a circle, multiples of 2 pi / num_turns of T_target_source.
            num_peaks: number of peaks of the similarity, around which headings are chosen.

        Returns:
            (p, num_turns) True for chosen headings; all of them if a scan has no walls.
        """
        curve, row = self.similarity(source, target), np.arange(len(source))[:, None]
        turns = np.broadcast_to(np.ptp(curve, axis=1)[:, None] < 1e-6, (len(source), num_turns)).copy()
        for _ in range(num_peaks):
            peak = curve.argmax(axis=1)[:, None]
            middle = np.round(peak * num_turns / NUM_DIRECTIONS).astype(int)
            turns[row, (middle + np.arange(-_TRIED_WIDTH, _TRIED_WIDTH + 1)) % num_turns] = True
            curve[row, (peak + np.arange(-_PEAK_WIDTH, _PEAK_WIDTH + 1)) % NUM_DIRECTIONS] = -np.inf
        return turns


def _spectra(scans: PlanarScans) -> Complex[np.ndarray, "n f"]:
    """Computes the spectra of the histograms, which have zero mean and unit norm."""
    normals, points = np.asarray(scans.normals, np.float64), np.asarray(scans.points, np.float64)
    ranges = np.linalg.norm(points, axis=-1)
    cosine = np.abs((normals * points).sum(-1)) / np.maximum(ranges, 1e-9)
    lengths = ranges / np.maximum(cosine, _MIN_COSINE)
    weights = np.asarray(scans.is_on_line) * lengths**_LENGTH_POWER
    histogram = _blurred(_histogram(np.arctan2(normals[..., 1], normals[..., 0]), weights))
    # The root keeps one long wall from hiding all others.
    shape = np.sqrt(np.maximum(histogram, 0.0))
    shape -= shape.mean(axis=1, keepdims=True)
    shape /= np.maximum(np.linalg.norm(shape, axis=1, keepdims=True), 1e-9)
    return np.fft.rfft(shape, axis=1).astype(np.complex64)


def _histogram(angles: Floats, weights: Floats) -> Floats:
    """Computes weighted histograms of angles; each angle adds to the two directions next to it."""
    place = np.mod(angles, 2 * np.pi) * (NUM_DIRECTIONS / (2 * np.pi))
    below: Indices = np.floor(place).astype(np.int64)
    share, histogram = place - below, np.zeros((len(angles), NUM_DIRECTIONS))
    rows = np.broadcast_to(np.arange(len(angles))[:, None], place.shape)
    np.add.at(histogram, (rows, below % NUM_DIRECTIONS), weights * (1 - share))
    np.add.at(histogram, (rows, (below + 1) % NUM_DIRECTIONS), weights * share)
    return histogram


def _blurred(histogram: Floats) -> Floats:
    apart = np.minimum(np.arange(NUM_DIRECTIONS), NUM_DIRECTIONS - np.arange(NUM_DIRECTIONS))
    kernel = np.exp(-0.5 * (apart / _BLUR) ** 2)
    spectrum = np.fft.rfft(histogram, axis=1) * np.fft.rfft(kernel / kernel.sum())
    return np.asarray(np.fft.irfft(spectrum, n=NUM_DIRECTIONS, axis=1), np.float64)

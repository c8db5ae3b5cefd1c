"""A small walk through the built-in world that the tests of this folder share: read-only."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.io import ScanSequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.scan import PlanarScans, planar_scans
from dpmjax.simulation import simulate_sequence

NUM_SCANS, NUM_BEAMS = 24, 128


def scans_of(sequence: ScanSequence, *, is_ordered: bool = True) -> PlanarScans:
    return planar_scans(sequence.points, sequence.mask, is_ordered=is_ordered)


def ate(poses: np.ndarray, reference: np.ndarray) -> float:
    return absolute_trajectory_error(poses[:, :2], reference[:, :2])


@pytest.fixture(scope="session")
def walk() -> ScanSequence:
    return simulate_sequence(0, NUM_SCANS, num_beams=NUM_BEAMS)


@pytest.fixture(scope="session")
def walk_scans(walk: ScanSequence) -> PlanarScans:
    return scans_of(walk)


@pytest.fixture(scope="session")
def noisy_walk() -> ScanSequence:
    return simulate_sequence(0, NUM_SCANS, num_beams=NUM_BEAMS, range_noise_px=1.0)


@pytest.fixture(scope="session")
def noisy_walk_scans(noisy_walk: ScanSequence) -> PlanarScans:
    return scans_of(noisy_walk)

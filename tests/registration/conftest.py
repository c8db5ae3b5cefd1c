"""A small walk through the built-in world that the tests of this folder share: read-only."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from dpmjax.io import ScanSequence
from dpmjax.registration.line_fitting import LineScans, fit_lines
from dpmjax.simulation import simulate_sequence
from dpmjax.types import ScanSet

NUM_SCANS, NUM_BEAMS = 24, 128


def lines_of(sequence: ScanSequence) -> LineScans:
    return fit_lines(ScanSet(jnp.asarray(sequence.points), jnp.asarray(sequence.mask)))


@pytest.fixture(scope="session")
def walk() -> ScanSequence:
    return simulate_sequence(0, NUM_SCANS, num_beams=NUM_BEAMS)


@pytest.fixture(scope="session")
def walk_lines(walk: ScanSequence) -> LineScans:
    return lines_of(walk)


@pytest.fixture(scope="session")
def noisy_walk() -> ScanSequence:
    return simulate_sequence(0, NUM_SCANS, num_beams=NUM_BEAMS, range_noise_px=1.0)


@pytest.fixture(scope="session")
def noisy_walk_lines(noisy_walk: ScanSequence) -> LineScans:
    return lines_of(noisy_walk)

"""A tiny walk and tiny depth images that the tests of this folder share: read-only."""

import numpy as np
import pytest

from dpmjax import simulation
from dpmjax.deepmapping.mapping import mapping_data
from dpmjax.deepmapping.problem import MappingData
from dpmjax.io import DepthSequence, ScanSequence
from dpmjax.scan import DepthScans, as_depth_scans
from dpmjax.types import ScanSet

NUM_SCANS, NUM_BEAMS = 20, 64


@pytest.fixture(scope="session")
def tiny_walk() -> ScanSequence:
    return simulation.simulate_sequence(0, NUM_SCANS, num_beams=NUM_BEAMS)


@pytest.fixture(scope="session")
def tiny_data(tiny_walk: ScanSequence) -> MappingData:
    """In typical ranges, without a start."""
    return mapping_data(ScanSet(tiny_walk.points, tiny_walk.mask))[0]


@pytest.fixture(scope="session")
def shaken(tiny_walk: ScanSequence) -> np.ndarray:
    """Poses some pixels and degrees off."""
    rng = np.random.default_rng(0)
    return tiny_walk.reference_poses + rng.normal(size=(NUM_SCANS, 3)) * [8.0, 8.0, 0.05]


@pytest.fixture(scope="session")
def walk() -> DepthSequence:
    config = simulation.DepthWalkConfig(height=12, width=16)
    return simulation.simulate_depth_sequence(0, 4, seed=1, config=config)


@pytest.fixture(scope="session")
def scans(walk) -> DepthScans:
    return as_depth_scans(walk.points, walk.mask)

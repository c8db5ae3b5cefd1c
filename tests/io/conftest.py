"""Small sequences for the tests of `dpmjax.io`."""

import numpy as np
import pytest

from dpmjax.io import ScanSequence


@pytest.fixture
def small():
    """Three scans of twenty beams in px, one beam invalid, with reference poses."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 5, 20)
    points = (rng.uniform(50, 300, (3, 20, 1)) * np.stack([np.cos(angles), np.sin(angles)], -1)).astype(np.float32)
    mask = np.ones((3, 20), bool)
    mask[1, 2] = False
    points[~mask] = 0
    return ScanSequence("small", points, mask, "px", reference_poses=rng.normal(size=(3, 3)))

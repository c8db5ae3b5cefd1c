"""What the tests of `dpmjax.io` share: where real data lies, and small sequences."""

import os
from pathlib import Path

import numpy as np
import pytest

from dpmjax.io import ScanSequence


@pytest.fixture
def real_data():
    """Folder of the real data; the test is skipped where there is none."""
    folder = Path(os.environ.get("DPMJAX_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data in {folder} (set DPMJAX_DATA)")
    return folder


@pytest.fixture
def small():
    """Three scans of five beams in px, one beam invalid, with reference poses."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 5, 5)
    points = (rng.uniform(50, 300, (3, 5, 1)) * np.stack([np.cos(angles), np.sin(angles)], -1)).astype(np.float32)
    mask = np.ones((3, 5), bool)
    mask[1, 2] = False
    points[~mask] = 0
    return ScanSequence("small", points, mask, "px", reference_poses=rng.normal(size=(3, 3)))

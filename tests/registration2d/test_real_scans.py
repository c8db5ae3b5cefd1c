"""Real scans of a corridor, where they exist: the kept map is better than the odometry, and a mirrored one is named."""

from __future__ import annotations

import os
from pathlib import Path

import jax
import numpy as np
import pytest

from dpmjax.io import read_sequence
from dpmjax.registration2d import RegisteredScans, RegistrationConfig, RegistrationHooks, register_scans
from dpmjax.sequences import ScanSequence
from dpmjax.types import ScanSet
from tests.registration2d.conftest import ate
from tests.registration2d.test_pipeline import SHORT, Untrained

DATA = Path(os.environ.get("DPMJAX_DATA", Path(__file__).parents[3] / "shared" / "data")) / "field_2d"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.is_dir(), reason="real scans: set DPMJAX_DATA to their folder"),
]


def register(name: str) -> tuple[ScanSequence, RegisteredScans]:
    """The registration without a trained fit."""
    sequence = read_sequence(DATA / f"{name}.npz")
    config = RegistrationConfig(fit=SHORT.fit, min_distance=0.5)
    scans = ScanSet(np.asarray(sequence.points), np.asarray(sequence.mask))
    hooks = RegistrationHooks(engine=Untrained(0))
    return sequence, register_scans(scans, config, key=jax.random.key(0), odometry=sequence.odometry_poses, hooks=hooks)


def test_what_is_kept_of_a_corridor_is_better_than_its_odometry() -> None:
    sequence, found = register("aca_corridor")
    assert ate(found.poses, sequence.reference_poses) < 0.31


def test_a_mirrored_log_is_named_and_not_trusted() -> None:
    _, found = register("aca_mirror80")
    assert "mirrored" in str(found.assessment.fault)
    assert not found.assessment.is_trusted

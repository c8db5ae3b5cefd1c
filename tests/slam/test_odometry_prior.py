"""Odometry of the robot as first guess, and the comparison with it afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.metrics import compare_odometry
from dpmjax.slam import SlamConfig, SlamMethods, run_slam
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, pose, scans_of

TRUTH = laps(1, side_m=30.0, step_m=1.0)


@pytest.mark.parametrize("delay", [-4, 0, 3])
def test_late_odometry_is_told_from_a_bad_one(delay: int) -> None:
    # Speeds change, so that a shift in time is seen.
    path = np.cumsum(1.0 + 0.5 * np.sin(0.4 * np.arange(80)))
    truth = np.array([pose(x, 0.0, 0.02 * row) for row, x in enumerate(path)])
    late = truth[np.clip(np.arange(80) - delay, 0, 79)]
    found = compare_odometry(pose(5.0, 3.0, 1.0) @ late, truth)
    assert found.delay_scans == delay
    assert found.undelayed_step < 1e-9
    assert (found.step < 1e-9) == (delay == 0)


def test_noise_is_no_delay() -> None:
    rng = np.random.default_rng(0)
    noisy = TRUTH.copy()
    noisy[:, :3, 3] += 0.2 * rng.standard_normal((len(TRUTH), 3))
    found = compare_odometry(noisy, TRUTH)
    assert found.delay_scans == 0
    assert 0.2 < found.step < 0.7
    noisy[40:50] = np.nan
    assert np.isfinite(compare_odometry(noisy, TRUTH).step)


def test_scans_without_odometry_keep_the_last_motion() -> None:
    methods = SlamMethods(TruthMatcher(TRUTH), TruthGeometry(TRUTH), SlamConfig())
    nowhere = np.full((len(TRUTH), 4, 4), np.nan)
    found, wanted = (run_slam(methods, scans_of(range(20)), odometry=each).T_world_scan for each in (nowhere, None))
    np.testing.assert_array_equal(found, wanted)

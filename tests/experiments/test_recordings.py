"""Which scans of a recording are registered, by odometry or by the scans alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.simulation import simulate_sequence
from experiments import _recordings
from experiments._recordings import MIN_DISTANCE_M, MIN_TURN_RAD, choose_scans

METRES_A_PX = 0.02


@pytest.fixture(scope="module")
def whole():
    """Forty scans about 15 cm apart, with odometry that tells nonsense."""
    walk = simulate_sequence(0, 40, seed=3, num_beams=128)
    poses = np.asarray(walk.reference_poses) * [METRES_A_PX, METRES_A_PX, 1.0]
    points = (walk.points * METRES_A_PX).astype(np.float32)
    return replace(walk, points=points, unit="m", reference_poses=poses, odometry_poses=np.zeros((40, 3)))


def test_the_scans_alone_tell_which_lie_apart(whole, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_recordings, "MAX_WHOLE", 20)
    log, truth = choose_scans(whole, by_scans=True), whole.reference_poses
    assert log.chosen[0] == 0
    assert log.chosen[-1] == 39
    assert 5 < len(log.chosen) < 20
    steps = se2.relative(truth[log.chosen[:-2]], truth[log.chosen[1:-1]])
    is_apart = np.hypot(steps[:, 0], steps[:, 1]) > 0.9 * MIN_DISTANCE_M
    assert (is_apart | (np.abs(steps[:, 2]) > 0.9 * MIN_TURN_RAD)).all()
    filled = log.between(truth[log.chosen])
    assert np.hypot(*(filled - truth)[:, :2].T).max() < 0.05


def test_a_recording_without_odometry_is_thinned_like_one_whose_odometry_is_not_looked_at(
    whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_recordings, "MAX_WHOLE", 20)
    without = choose_scans(replace(whole, odometry_poses=None))
    np.testing.assert_array_equal(without.chosen, choose_scans(whole, by_scans=True).chosen)


def test_few_scans_without_odometry_are_all_registered(whole) -> None:
    assert len(choose_scans(whole, by_scans=True).chosen) == 40
    assert len(choose_scans(replace(whole, unit="px")).chosen) == 40
    assert len(choose_scans(whole, is_ordered=False).chosen) == 40
    # Odometry that stands still: the first and the last scan.
    assert len(choose_scans(whole).chosen) == 2

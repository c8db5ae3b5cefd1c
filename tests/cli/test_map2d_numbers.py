"""The numbers by which maps of planar scans are measured."""

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.cli.map2d import trust_verdict
from dpmjax.geometry import se2
from dpmjax.metrics import corrected_ate, planar_errors
from dpmjax.simulation import simulate_sequence


def test_a_corrected_log_measures_the_scans_that_both_have() -> None:
    walk = simulate_sequence(0, 24, num_beams=64, seed=4)
    times = np.arange(24.0)
    corrected = replace(walk, unit="m", times=times).take(slice(0, None, 2))
    moved = np.asarray(se2.compose(np.array([50.0, -3.0, 1.0]), walk.reference_poses))
    assert corrected_ate(times, moved, corrected) < 1e-9
    moved[2, 0] += 12.0
    # One of twelve is off by 12; the best alignment takes at most a part of that.
    assert 2.0 < corrected_ate(times, moved, corrected) < np.sqrt(12.0)
    with pytest.raises(ValueError, match="0 scans have the time"):
        corrected_ate(times + 0.3, moved, corrected)


def test_the_worst_scan_is_the_farthest_from_its_reference() -> None:
    walk = simulate_sequence(0, 24, num_beams=64, seed=4)
    poses = walk.reference_poses.copy()
    poses[20, :2] += [3.0, 4.0]
    found = planar_errors(walk, np.asarray(se2.compose(np.array([50.0, -3.0, 1.0]), poses)))
    # The best alignment takes a part of the five pixels.
    assert 4.5 < found["worst_scan_px"] < 5.0
    assert planar_errors(walk, walk.reference_poses)["worst_scan_px"] < 1e-9


@pytest.mark.parametrize(("rows", "spans"), [([4], "4"), ([3, 4, 5, 9], "3-5, 9"), ([0, 2, 3], "0, 2-3")])
def test_the_verdict_names_the_uncertain_scans_and_the_fault(rows: list[int], spans: str) -> None:
    assessment = {"is_trusted": False, "weakest_connection": 0.3, "contradiction": 0.01}
    text = trust_verdict(assessment | {"uncertain_scans": rows, "fault": "the scans are mirrored"})
    assert "DO NOT TRUST" in text
    assert text.endswith(f" {spans}")
    assert "the scans are mirrored" in text

"""Gross errors in place of the matcher, on a short drive; `python -m benchmarks --only slam` has 4 km."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import slam

TRUTH = slam.route(0, 600.0, kind="there_and_back")


@pytest.fixture(scope="module")
def result():
    return slam.drive(TRUTH, 0)


@pytest.mark.slow
def test_gross_errors_of_the_matcher_leave_the_map_whole(result) -> None:
    proof = slam.judged(result, TRUTH)
    assert proof.num_wrong == 0
    assert proof.num_opposite >= 10
    assert proof.ate_m < 1.0
    assert proof.ate_m < proof.ate_odometry_m


@pytest.mark.slow
def test_a_wrong_loop_is_counted(result) -> None:
    loops = list(result.loops)
    first = next(number for number, loop in enumerate(loops) if loop.status == "accepted")
    T = loops[first].T_target_source.copy()
    T[0, 3] += 3.0
    loops[first] = loops[first]._replace(T_target_source=T)
    assert slam.judged(result._replace(loops=tuple(loops)), TRUTH).num_wrong == 1


def test_a_route_is_a_scan_a_metre_along_its_own_direction() -> None:
    truth = slam.route(3, 600.0)
    steps = np.diff(truth[:, :2, 3], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), slam.STEP_M, atol=0.15)
    assert np.einsum("ni,ni->n", truth[:-1, :2, 0], steps).mean() > 0.98


@pytest.mark.slow
def test_costs_are_counted_at_every_moment() -> None:
    early, late = slam.costs(slam.route(0, 600.0)[:400], (150, 300))
    assert early.cpu_ms > 0
    assert early.map_mb < late.map_mb
    assert late.front_end_mb < 1.1 * early.front_end_mb

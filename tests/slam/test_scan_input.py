"""Laws of work in advance."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import numpy as np
import pytest

from dpmjax.scan import Scan
from dpmjax.slam import SlamConfig, SlamMethods, TimedScan, in_advance, run_slam
from dpmjax.slam.system import corrected_points
from tests.slam.truth import TruthGeometry, TruthMatcher, pose


@pytest.mark.parametrize("num", [0, 1, 5])
def test_results_come_in_order(num) -> None:
    assert list(in_advance(lambda item: item**2, range(num))) == [item**2 for item in range(num)]


def test_the_next_item_is_worked_on_while_the_caller_uses_this_one() -> None:
    begun = [threading.Event() for _ in range(3)]

    def work(item: int) -> int:
        begun[item].set()
        return item

    for item in in_advance(work, range(3)):
        # Without the thread this waits in vain.
        assert item == 2 or begun[item + 1].wait(timeout=10)


def test_an_error_takes_the_place_of_its_result() -> None:
    results = in_advance(lambda item: 1 // item, [1, 0, 1])
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_another_number_of_times_than_of_points_is_refused(as_user) -> None:
    with pytest.raises(ValueError, match=r"scan.offsets: expected shape \(5,\), got \(4,\)"):
        corrected_points(TimedScan(np.zeros((5, 3)), np.zeros(4)), np.eye(4))


@dataclass(frozen=True)
class MovingGeometry(TruthGeometry):
    """Keeps the shifts of the second point of each scan, which was measured half a step after the first."""

    shifts_m: list[tuple[int, float]] = field(default_factory=list)

    def thin(self, points: np.ndarray) -> Scan | None:
        self.shifts_m.append((round(float(points[0, 0])), float(points[1, 0])))
        return super().thin(points[:1])


def test_the_first_two_scans_are_deskewed_by_the_motion_between_them() -> None:
    truth = np.array([pose(2.0 * number, 0.0, 0.0) for number in range(4)])
    geometry = MovingGeometry(truth, sigma_m=1e-4, sigma_rad=1e-5)
    scans = [TimedScan(np.array([[number, 0.0, 0], [0, 0, 0]]), np.array([0.0, 0.5])) for number in range(4)]
    result = run_slam(SlamMethods(TruthMatcher(truth), geometry, SlamConfig()), scans)
    last = dict(geometry.shifts_m)
    np.testing.assert_allclose([last[number] for number in range(4)], 1.0, atol=1e-3)
    np.testing.assert_allclose(result.T_world_scan[:, :3, 3], truth[:, :3, 3], atol=1e-2)
    assert len(result.reports) == 4

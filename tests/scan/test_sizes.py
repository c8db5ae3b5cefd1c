"""The size of a scan over that of another."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.scan.lidar.record import measure_scan
from dpmjax.scan.lidar.sizes import relative_size
from tests.scan.surface_scenes import motion, seen_from, street

T_TRUE = motion(8, (1.5, -0.4, 0.1))


@pytest.mark.parametrize("size", [0.9, 0.93, 0.97, 1.02, 1.06, 1.1])
def test_an_enlarged_scan_is_as_much_larger(size: float) -> None:
    source = measure_scan(size * seen_from(street(0), T_TRUE)).surface
    target = measure_scan(street(1)).surface
    # A registration without scale ends where most planes meet.
    found = relative_size(source, target, T_TRUE)
    assert found == pytest.approx(size, abs=0.004)
    assert found * relative_size(target, source, np.linalg.inv(T_TRUE)) == pytest.approx(1, abs=0.001)


def test_scans_of_one_size_and_of_different_places_have_size_one() -> None:
    source, target = (measure_scan(points).surface for points in (seen_from(street(0), T_TRUE), street(1)))
    assert relative_size(source, target, T_TRUE) == 1
    assert relative_size(source, target, motion(70, (9, 6, 0))) == 1
    empty = measure_scan(np.zeros((0, 3))).surface
    assert relative_size(source, empty, T_TRUE) == relative_size(empty, target, T_TRUE) == 1

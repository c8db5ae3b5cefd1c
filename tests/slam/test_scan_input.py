"""Laws of work in advance."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from dpmjax.slam import TimedScan, in_advance
from dpmjax.slam.system import corrected_points


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

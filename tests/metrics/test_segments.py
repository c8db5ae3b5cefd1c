"""Laws of the segment errors of KITTI, against a slow oracle."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.metrics import path_lengths, segment_error


def path(rng: np.random.Generator, num: int = 300, step_m: float = 1.3) -> np.ndarray:
    poses = np.tile(np.eye(4), (num, 1, 1))
    for row in range(1, num):
        move = np.eye(4)
        move[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
        move[0, 3] = step_m
        poses[row] = poses[row - 1] @ move
    return poses


def oracle(estimated: np.ndarray, reference: np.ndarray, lengths, stride: int) -> tuple[float, float, int]:
    way = [0.0]
    for a, b in itertools.pairwise(reference):
        way.append(way[-1] + float(np.linalg.norm(b[:3, 3] - a[:3, 3])))
    shifts, turns = [], []
    for first in range(0, len(way), stride):
        for length in lengths:
            last = next((row for row in range(first, len(way)) if way[row] > way[first] + length), None)
            if last is None:
                continue
            true = np.linalg.inv(reference[first]) @ reference[last]
            error = np.linalg.inv(np.linalg.inv(estimated[first]) @ estimated[last]) @ true
            shifts.append(np.linalg.norm(error[:3, 3]) / length)
            turns.append(np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) / length)
    return 100 * float(np.mean(shifts)), 100 * float(np.mean(turns)), len(shifts)


@pytest.mark.parametrize("stride", [1, 10])
def test_errors_are_those_of_the_definition(stride: int) -> None:
    reference, estimated = path(np.random.default_rng(0)), path(np.random.default_rng(1))
    found = segment_error(estimated, reference, lengths_m=(100.0, 200.0), stride=stride)
    np.testing.assert_allclose(found, oracle(estimated, reference, (100.0, 200.0), stride), rtol=1e-9)


def test_a_short_path_has_no_segment() -> None:
    found = segment_error(path(np.random.default_rng(0), 20), path(np.random.default_rng(0), 20))
    assert found.num_segments == 0
    assert np.isnan(found.translation_percent)


@pytest.mark.parametrize("num", [0, 1, 4])
def test_the_length_of_a_straight_path_is_that_of_its_steps(num: int) -> None:
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = 3.0 * np.arange(num), 4.0 * np.arange(num)
    np.testing.assert_allclose(path_lengths(T), 5.0 * np.arange(num))

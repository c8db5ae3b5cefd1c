"""Held-out places: the end of the path, with every scan that sees it."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.deeppointmap import split_places
from dpmjax.sequences import LidarSequence
from tests.deeppointmap import toy


def drive_along(positions: np.ndarray) -> LidarSequence:
    """A drive with these positions, whose scans are never read."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :2, 3] = positions
    return LidarSequence("made up", tuple(map(str, range(len(poses)))), lambda _: np.zeros((0, 3), np.float32), poses)


def line(num: int, step_m: float) -> np.ndarray:
    return np.stack([step_m * np.arange(num), np.zeros(num)], axis=1)


@pytest.mark.parametrize(("num", "step_m", "margin_m"), [(401, 2.0, 20.0), (101, 1.0, 10.0)])
def test_the_last_tenth_of_the_path_is_held_out_with_a_margin(num: int, step_m: float, margin_m: float) -> None:
    split = split_places(drive_along(line(num, step_m)))
    length_m = (num - 1) * step_m
    assert np.all(split.held_out * step_m > 0.9 * length_m)
    assert len(split.held_out) == round(0.1 * (num - 1))
    assert split.held_out[0] * step_m - split.training.max() * step_m >= margin_m
    np.testing.assert_array_equal(split.training, np.arange(len(split.training)))


def test_an_earlier_pass_of_a_held_out_place_is_not_trained_on() -> None:
    angles = np.linspace(0, 4 * np.pi, 800, endpoint=False)
    circle = 100 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    split = split_places(drive_along(circle))
    apart = np.linalg.norm(circle[split.training][:, None] - circle[split.held_out], axis=2)
    assert apart.min() >= 20.0
    assert split.held_out.min() > 700
    assert {row < 400 for row in split.training.tolist()} == {True, False}


@pytest.mark.parametrize("positions", [np.zeros((30, 2)), line(1, 1.0), np.zeros((0, 2))], ids=["room", "one", "none"])
def test_where_too_little_would_remain_nothing_is_held_out(positions: np.ndarray) -> None:
    split = split_places(drive_along(positions))
    assert (len(split.training), len(split.held_out)) == (len(positions), 0)


def test_a_drive_without_poses_is_refused() -> None:
    drive = toy.drive(num_scans=3)
    with pytest.raises(ValueError, match="expected a true pose for each scan"):
        split_places(LidarSequence("none", drive.sources, drive.read_scan))

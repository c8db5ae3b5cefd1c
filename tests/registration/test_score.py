from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.registration import length_scale, map_code_length
from dpmjax.simulation import simulate_sequence
from dpmjax.types import ScanSet


@pytest.fixture(scope="module")
def walk() -> ScanSequence:
    return simulate_sequence(0, 30, num_beams=128)


def score(walk: ScanSequence, poses: np.ndarray) -> float:
    scale = length_scale(ScanSet(walk.points, walk.mask))
    return map_code_length(walk.points, walk.mask, poses, scale=scale)


@pytest.mark.parametrize("px", [0.5, 1.0, 5.0])
def test_true_poses_need_fewer_nats_than_perturbed_ones(walk, px: float) -> None:
    rng = np.random.default_rng(0)
    perturbed = walk.reference_poses + rng.normal(size=(30, 3)) * [px, px, 0.002 * px]
    assert score(walk, walk.reference_poses) < score(walk, perturbed)


def test_more_pixels_off_need_more_nats(walk) -> None:
    shift = np.random.default_rng(1).normal(size=(30, 3)) * [1.0, 1.0, 0.002]
    scores = [score(walk, walk.reference_poses + px * shift) for px in (0.0, 1.0, 4.0, 16.0)]
    assert scores == sorted(scores)


def test_one_scan_that_is_turned_costs_nats(walk) -> None:
    turned = walk.reference_poses.copy()
    turned[15, 2] += 0.3
    assert score(walk, walk.reference_poses) < score(walk, turned)


@pytest.mark.parametrize("offset", [(300.0, -1234.5, 0.7), (-17.3, 5.1, 3.0)])
def test_where_the_world_begins_does_not_matter(walk, offset) -> None:
    moved = se2.compose(np.array([offset]), walk.reference_poses)
    assert score(walk, moved) == pytest.approx(score(walk, walk.reference_poses), rel=0.03)


def test_masked_beams_never_matter(walk) -> None:
    mask = walk.mask & (np.random.default_rng(2).uniform(size=walk.mask.shape) < 0.8)
    scores = {
        map_code_length(np.where(mask[..., None], walk.points, filling), mask, walk.reference_poses, scale=20.0)
        for filling in (0.0, 1e6, np.nan)
    }
    assert len(scores) == 1

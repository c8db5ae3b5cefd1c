"""Global registration of sequences, and the cost of the search of many pairs."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.registration2d import GlobalConfig, PlanarScans, incremental_icp, planar_scans, register_globally
from dpmjax.registration2d.pair_search import CorrelativeConfig, search_pairs
from dpmjax.simulation import simulate_sequence
from tests.registration2d.conftest import ate, scans_of

COARSE = CorrelativeConfig(num_cells=64, cell=0.075, num_turns=72, block=8, num_levels=5, num_candidates=3)


@pytest.fixture(scope="module")
def there() -> ScanSequence:
    """Thirteen scans of the office, 30 px apart."""
    return simulate_sequence(0, 49, seed=1).take(slice(0, None, 4))


def register_as_set(scans: PlanarScans, config: GlobalConfig, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Poses where the sequence says nothing."""
    module = importlib.import_module("dpmjax.registration2d.global_registration")
    monkeypatch.setattr(module, "weak_steps", lambda *_: np.ones(len(scans) - 1, bool))
    return register_globally(scans, config).poses


@pytest.mark.slow
@pytest.mark.parametrize("num_torn", [1, 12])
def test_torn_steps_are_healed_from_the_scans_alone(there, monkeypatch: pytest.MonkeyPatch, num_torn: int) -> None:
    """One weak step starts the search of all pairs of few scans. Many scans need many weak steps."""
    walk, max_keyframes = (there.take(slice(0, None, 2)), 32) if num_torn == 1 else (there, 6)
    truth = np.asarray(walk.reference_poses)
    torn = se2.relative(truth[0], truth)
    for step in range(1, num_torn + 1):
        torn[step:] = se2.compose(np.array([400.0, -300.0, 1.0]), torn[step:])
    known = incremental_icp(scans_of(walk.take(slice(2))))
    module = importlib.import_module("dpmjax.registration2d.global_registration")
    monkeypatch.setattr(module, "incremental_icp", lambda _: known._replace(poses=torn))
    found = register_globally(scans_of(walk), GlobalConfig(max_keyframes=max_keyframes, search=COARSE))
    assert ate(torn, truth) > 50.0
    assert ate(found.poses, truth) < 4.0


@pytest.mark.slow
def test_a_sequence_of_strong_steps_needs_no_other_search(there) -> None:
    found = register_globally(scans_of(there), GlobalConfig(search=COARSE))
    assert len(found.keyframes) == 0
    assert ate(found.poses, np.asarray(there.reference_poses)) < 1.0


@pytest.mark.slow
def test_a_robot_may_go_out_and_back_between_two_keyframes(there, monkeypatch: pytest.MonkeyPatch) -> None:
    out = there.take(slice(5))
    truth = np.asarray(out.reference_poses)
    turns = np.arange(1, 5) * np.pi / 4
    poses = np.concatenate(
        [truth, truth[-1] + turns[:, None] * [0.0, 0.0, 1.0], truth[-2::-1] + np.array([0.0, 0.0, np.pi])]
    )
    rows = np.concatenate([np.arange(5), np.full(4, 4), np.arange(3, -1, -1)])
    turned = se2.transform_points(se2.relative(poses, out.reference_poses[rows]), out.points[rows])
    # Both keyframes lie where the robot starts and ends.
    scans, config = planar_scans(turned.astype(np.float32), out.mask[rows]), GlobalConfig(max_keyframes=2)
    assert ate(register_globally(scans, config).poses, poses) < 2.0
    assert ate(register_as_set(scans, config, monkeypatch), poses) < 4.0


@pytest.mark.slow
def test_pairs_in_batches_are_those_of_one_search(there, monkeypatch: pytest.MonkeyPatch) -> None:
    scans, source, target = scans_of(there), np.array([5, 1, 3, 1, 2]), np.array([4, 0, 2, 3, 1])
    turns = np.zeros((5, COARSE.num_turns), bool)
    turns[:, [0, 1, -1]] = True
    search = replace(COARSE, num_levels=1)
    whole = search_pairs(scans, source, target, search, turns=turns)
    monkeypatch.setattr(importlib.import_module("dpmjax.registration2d.pair_search"), "_SEARCH_BATCH", 2)
    batched = search_pairs(scans, source, target, search, turns=turns)
    np.testing.assert_array_equal(batched.source, source)
    np.testing.assert_array_equal(whole.target, target)
    np.testing.assert_allclose(batched.poses[:, 0], whole.poses[:, 0], atol=1e-4)
    np.testing.assert_allclose(batched.scores[:, 0], whole.scores[:, 0], rtol=1e-4)

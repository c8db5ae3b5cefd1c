"""Calibration on the drives of a user: fitted on the training part, measured on held-out places."""

import numpy as np
import pytest

from dpmjax.deeppointmap import OVERLAP_FEATURES
from dpmjax.deeppointmap.calibration import KINDS, MeasuredDrives, calibrate, column_of, fit_confidence, measure_overlap
from tests.deeppointmap import toy


def registrations(num: int, place: int, *, is_right: bool | None = None) -> list[dict]:
    """Registrations whose features say how probably they are right."""
    rng, rows = np.random.default_rng(place), []
    for _ in range(num):
        right = rng.uniform() < 0.5 if is_right is None else is_right
        row = {"place": place, "is_right": right, "is_right_of_clouds": right, "distance_m": 5.0}
        for kind, names in KINDS.items():
            row |= {column_of(kind, name): rng.normal() + right if kind != "of_weak_scans" else None for name in names}
        rows.append(row)
    return rows


def matches(num: int, seed: int) -> list[dict]:
    """Matches whose first number tells overlap, and a head that knows less."""
    rng = np.random.default_rng(seed)
    is_overlap = np.arange(num) % 2 == 0
    evidence = rng.normal(size=(num, len(OVERLAP_FEATURES)))
    evidence[:, 0] += 3 * is_overlap
    head = 1 / (1 + np.exp(-rng.normal(size=num) - 0.5 * is_overlap))
    return [
        {**dict(zip(OVERLAP_FEATURES, row, strict=True)), "is_overlap": label, "head": probability}
        for row, label, probability in zip(evidence, is_overlap, head, strict=True)
    ]


def test_fits_are_measured_on_held_out_places(model) -> None:
    of_places = [*registrations(60, 0), *registrations(60, 1)], registrations(60, 2)
    measured = MeasuredDrives(*of_places, matches(200, 3), matches(100, 4))
    calibrated, numbers = calibrate(model, measured)
    assert calibrated.config.calibration is not None
    assert calibrated.config.calibration.of_weak_scans is None
    assert calibrated.config.overlap.weights[0] > 1
    assert (numbers["num_pairs"], numbers["num_overlap_pairs"], numbers["num_tested_overlap_pairs"]) == (120, 200, 100)
    assert numbers["brier_of_scans"] < numbers["brier_of_a_constant_of_scans"]
    assert numbers["auc_overlap"] > 0.9 > numbers["auc_head"] > 0.5
    toy.assert_trees_equal(calibrated.params, model.params)


def test_what_the_pairs_cannot_fix_is_left_out(model) -> None:
    measured = MeasuredDrives(registrations(20, 0, is_right=True), [], [], [])
    calibrated, numbers = calibrate(model, measured)
    assert (calibrated.config.calibration, calibrated.config.overlap) == (None, None)
    assert numbers == {"num_pairs": 20}


def test_without_other_places_each_one_is_left_out_in_turn() -> None:
    calibration, numbers, held_out = fit_confidence([row for place in range(3) for row in registrations(60, place)])
    assert calibration is not None
    assert len(held_out["of_scans"][0]) == 180
    assert numbers["brier_of_scans"] < 0.25


@pytest.mark.slow
def test_tested_pairs_hold_a_scan_of_the_held_out_places(model, monkeypatch) -> None:
    from dpmjax.deeppointmap import calibration

    drives, drawn = [toy.drive(1), toy.drive(2)], []
    draw = calibration.draw_overlap_pairs

    def recorded(*args, **options):
        drawn.append(draw(*args, **options))
        return drawn[-1]

    monkeypatch.setattr(calibration, "draw_overlap_pairs", recorded)
    found = measure_overlap(model, drives, 16, 0, anchors=[np.array([22, 23]), np.array([20])])
    assert {22, 23, 44} >= set(drawn[0][:, 0].tolist())
    assert len(found) == 16
    assert sum(row["is_overlap"] for row in found) == 8
    assert {*OVERLAP_FEATURES, "is_overlap", "head"} == found[0].keys()
    assert measure_overlap(model, [toy.drive(1, num_scans=3)], 8, 0) == []

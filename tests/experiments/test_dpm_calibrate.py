"""Calibration on simulated places, its check, and the weights of the evidence."""

from dataclasses import replace

import numpy as np
import pytest

import dpmjax
from dpmjax import deeppointmap as dpm
from dpmjax import simulation
from dpmjax.cli.run import EXIT_OK, load_json
from dpmjax.deeppointmap.evaluation import StagedRegistration
from experiments import dpm_calibrate
from tests.deeppointmap import toy
from tests.experiments.running import read_rows, run


@pytest.fixture
def kinds(monkeypatch) -> list[str | None]:
    """Registrations of small drives that are right as often as their features say; the kinds of places simulated."""
    kinds, motions, rng = [], [], np.random.default_rng(0)

    def simulate_drive(seed, *, length_m, kind=None, sensor=None, mixture=None):
        kinds.append(kind)
        return toy.drive(seed)

    def staged(model, pair):
        is_right = rng.uniform() < 0.5
        T = pair.T_target_source if is_right else np.eye(4)
        of_clouds = rng.normal(size=4) + is_right
        evidence = dpm.MatchEvidence(
            np.full(4, 1e6 * is_right),  # of the motion that the scans chose: no feature of clouds
            np.concatenate([of_clouds, rng.normal(size=len(dpm.SCAN_FEATURES) - 4) + 2 * is_right]),
            rng.normal(size=len(dpm.WEAK_FEATURES)) + 2 * is_right if rng.uniform() < 0.5 else None,
        )
        of_elements = np.concatenate([of_clouds, rng.normal(size=len(dpm.ELEMENT_FEATURES) - 4) + is_right])
        motions.append((T, dpm.MatchEvidence(of_clouds, None, of_elements=of_elements)))
        return StagedRegistration(T, T, T, evidence, 0.5, 0.0)

    monkeypatch.setattr(simulation, "simulate_drive", simulate_drive)
    monkeypatch.setattr(dpm.calibration, "encode", lambda model, points, num_elements: points)
    monkeypatch.setattr(dpm.calibration, "register_in_stages", staged)
    monkeypatch.setattr(dpm.calibration, "register_clouds", lambda *_: motions[-1])
    return kinds


def test_every_place_opens(kinds) -> None:
    places = dpm_calibrate.list_places()
    for place in places:
        dpm_calibrate.open_place(**place)
    assert kinds == [place["kind"] for place in places]


@pytest.mark.slow
def test_calibration_is_stored_in_a_copy_of_the_model_and_resumes(weights, kinds, tmp_path, monkeypatch) -> None:
    sizes = {"NUM_PAIRS": 20, "NUM_OVERLAP_PAIRS": 16, "NUM_TOWNS": 3, "NUM_AMBIGUOUS": 2, "NUM_OVERLAP_TOWNS": 2}
    for name, number in sizes.items():
        monkeypatch.setattr(dpm_calibrate, name, number)
    out = tmp_path / "out"
    assert run(dpm_calibrate, weights, "-o", out) == EXIT_OK
    assert len(set(kinds[:3])) == 3  # of towns for confidence; those for overlap are of any kind
    assert kinds[3:5] == ["corridor", "tunnel"]
    assert set(kinds[5:]) == {None}
    model, metrics = dpmjax.load_model(out / "model.safetensors"), load_json(out / "metrics.json")
    assert max(model.config.calibration.of_scans.weights[4:]) > 0
    assert min(model.config.calibration.of_weak_scans.weights) > 0
    assert min(model.config.calibration.of_elements.weights) > 0
    assert metrics["brier_of_scans"] < metrics["brier_of_clouds"] < metrics["brier_of_a_constant_of_clouds"]
    assert (metrics["num_pairs"], metrics["num_overlap_pairs"]) == (300, 32)
    assert 0 <= metrics["auc_overlap"] <= 1
    assert (out / "reliability_overlap.png").stat().st_size > 0
    note = "Confidence calibrated on 3 towns and 2 ambiguous places, 300 pairs; overlap fitted on 2 towns, 32 pairs"
    assert note in dpmjax.weights.read_card(out / "model.safetensors")
    kinds.clear()
    assert run(dpm_calibrate, "--resume", "-o", out) == EXIT_OK
    assert kinds == []
    assert load_json(out / "metrics.json")["brier_of_scans"] == metrics["brier_of_scans"]


def test_a_calibration_is_rated_by_what_it_is_sure_of() -> None:
    """Three sure registrations, of which one is wrong; clouds rest on features of their own."""
    of_scans = dpm.LogisticModel(dpm.SCAN_FEATURES, (0.0,) * 7 + (10.0, 0.0), 0.0)
    calibration = dpm.Calibration(dpm.LogisticModel(dpm.CLOUD_FEATURES, (0.0,) * 4, -5.0), of_scans)
    rows = []
    for score, right, distance_m in ((1.0, True, 2.0), (1.0, True, 8.0), (1.0, False, 3.0), (-1.0, False, 4.0)):
        row = {"kind": "hall", "is_right": right, "is_right_of_clouds": False, "distance_m": distance_m}
        values = dict.fromkeys(dpm.SCAN_FEATURES, 0.0) | {"score": score}
        row |= {f"of_scans {name}": value for name, value in values.items()}
        row |= {f"of_clouds {name}": 0.0 for name in dpm.CLOUD_FEATURES}
        row |= {f"of_weak_scans {name}": None for name in dpm.WEAK_FEATURES}
        has_elements = distance_m != 4.0
        row |= {f"of_elements {name}": 0.0 if has_elements else None for name in dpm.ELEMENT_FEATURES}
        rows.append(row)

    def sure(calibration: dpm.Calibration, *, of_clouds: bool) -> list[bool]:
        return [dpm.rate_pair(calibration, row, of_clouds=of_clouds) >= 0.9 for row in rows]

    assert sure(calibration, of_clouds=False) == [True, True, True, False]
    assert not any(sure(calibration, of_clouds=True))
    by_elements = replace(calibration, of_elements=dpm.LogisticModel(dpm.ELEMENT_FEATURES, (0.0,) * 8, 5.0))
    assert sure(by_elements, of_clouds=True) == [True, True, True, False]
    rows[0]["lookalike_gap_of_scans"] = 0.0  # another place fits as well
    assert sure(calibration, of_clouds=False) == [False, True, True, False]


def test_the_weights_that_made_the_evidence_are_found(weights, tmp_path, monkeypatch) -> None:
    """Motions that are right as often as known weights say; the fit finds these weights, scene by scene."""
    true, rng = np.array([-2.0, 8.0, -3.0, 0.0, 0.0, 2.0, -5.0]), np.random.default_rng(0)

    def measure(model, drive, rows, thinned, seed):
        shares = rng.uniform(size=(90, 6))
        return shares, rng.uniform(size=90) < 1 / (1 + np.exp(-true[0] - shares @ true[1:]))

    monkeypatch.setattr(dpm_calibrate, "measure_motions", measure)
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    monkeypatch.setattr(dpm_calibrate, "SCENES", {False: "suburb HDL64E, hall OS1_64", True: "suburb HDL64E"})
    out = tmp_path / "out"
    assert run(dpm_calibrate, weights, "--evidence", "-o", out) == EXIT_OK
    metrics = load_json(out / "metrics.json")
    found = np.array(list(metrics["evidence"].values()))
    np.testing.assert_allclose(found, true, atol=0.6)
    assert [row["kind"] for row in read_rows(out)] == ["suburb", "hall", "suburb"]
    assert min(metrics["right_by_present"], metrics["right_by_fitted"]) > 0.3
    monkeypatch.setattr(dpm_calibrate, "measure_motions", None)
    assert run(dpm_calibrate, "--resume", "-o", out) == EXIT_OK
    assert load_json(out / "metrics.json")["evidence"] == metrics["evidence"]

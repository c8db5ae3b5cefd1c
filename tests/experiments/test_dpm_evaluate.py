"""The commands that measure and calibrate a model, on a network that compiles in seconds."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax import cli, deeppointmap, simulation
from dpmjax.cli.command import EXIT_BAD_INPUT, EXIT_OK, run_command
from dpmjax.cli.result_files import load_json
from dpmjax.deeppointmap import (
    CLOUD_FEATURES,
    ELEMENT_FEATURES,
    OVERLAP_FEATURES,
    SCAN_FEATURES,
    WEAK_FEATURES,
    Calibration,
    LogisticModel,
    MatchEvidence,
)
from dpmjax.deeppointmap.scan_evaluation import StagedRegistration
from experiments import dpm_calibrate, dpm_confidence, dpm_evaluate
from tests.deeppointmap import toy


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "model.safetensors"
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.MODEL), path, card="toy")
    return path


def run(module, arguments) -> int:
    arguments = list(map(str, arguments))
    return run_command(module.main, module.Config, name=module.EXPERIMENT, description=module.__doc__, args=arguments)


@pytest.mark.slow
def test_evaluation_measures_every_sequence_and_resumes(weights, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    monkeypatch.setattr("dpmjax.cli.why_not_importable", lambda _: "it is not installed")
    arguments = ["town", "--weights", weights, "--pairs", 2, "--num-towns", 1, "-o", tmp_path / "out"]
    assert run(dpm_evaluate, arguments) == EXIT_OK
    printed = capsys.readouterr().out
    assert "| toy 5000000 | 2-10 m | 2 |" in printed
    assert "KISS-Matcher was not run: it is not installed." in printed
    metrics = load_json(tmp_path / "out" / "metrics.json")
    by_band = {row["band"]: row for row in metrics["rows"]}
    assert set(by_band) == {"near", "middle", "far", "all"}
    assert len(by_band["near"]["translation_errors_refined_m"]) == 2
    assert 0 <= metrics["brier"] <= 1
    assert 0 <= by_band["all"]["auc"] <= 1
    for name in ("table.md", "reliability.png", "failures.png"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    # All rows are there: nothing is registered again.
    monkeypatch.setattr(deeppointmap, "evaluate_scan_pairs", None)
    assert run(dpm_evaluate, ["--resume", "-o", tmp_path / "out"]) == EXIT_OK
    assert load_json(tmp_path / "out" / "metrics.json")["rows"] == metrics["rows"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "--weights", "WEIGHTS"], "nowhere"),
        (["town", "--weights", "no_such_model"], "no_such_model"),
    ],
)
def test_bad_input_is_one_line(weights, tmp_path, capsys, arguments, message: str) -> None:
    given = [str(weights) if argument == "WEIGHTS" else argument for argument in arguments]
    assert run(dpm_evaluate, [*given, "-o", tmp_path / "out"]) == EXIT_BAD_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_calibration_is_stored_in_a_copy_of_the_model(weights, tmp_path, monkeypatch) -> None:
    kinds = []

    def simulate_drive(seed, *, length_m, kind=None, sensor=None, mixture=None):
        kinds.append(kind)
        return toy.drive(seed)

    monkeypatch.setattr(simulation, "simulate_drive", simulate_drive)
    monkeypatch.setattr(deeppointmap, "encode", lambda model, points, num_elements: points)
    rng = np.random.default_rng(0)

    def found(model, pair):
        """Registrations that are right as often as their features say."""
        is_right = rng.uniform() < 0.5
        T = pair.T_target_source if is_right else np.eye(4)
        of_clouds = rng.normal(size=4) + is_right
        evidence = MatchEvidence(
            np.full(4, 1e6 * is_right),  # of the motion that the scans chose: no feature of clouds
            np.concatenate([of_clouds, rng.normal(size=len(SCAN_FEATURES) - 4) + 2 * is_right]),
            rng.normal(size=len(WEAK_FEATURES)) + 2 * is_right if rng.uniform() < 0.5 else None,
        )
        of_elements = np.concatenate([of_clouds, rng.normal(size=len(ELEMENT_FEATURES) - 4) + is_right])
        evidence_of_clouds = MatchEvidence(of_clouds, None, of_elements=of_elements)
        return StagedRegistration(T, T, T, evidence, 0.0), evidence_of_clouds

    motions = []

    def staged(model, pair):
        motions.append(found(model, pair))
        return motions[-1][0]

    def of_clouds(model, source, target):
        """The match of the same two scans as clouds: right where they are."""
        return motions[-1][0].descriptors, motions[-1][1]

    monkeypatch.setattr(deeppointmap, "register_in_stages", staged)
    monkeypatch.setattr(deeppointmap, "register_clouds", of_clouds)
    monkeypatch.setattr(dpm_calibrate, "NUM_PAIRS", 20)
    monkeypatch.setattr(dpm_calibrate, "NUM_OVERLAP_PAIRS", 16)
    for name, number in (("NUM_TOWNS", 3), ("NUM_AMBIGUOUS", 2), ("NUM_OVERLAP_TOWNS", 2)):
        monkeypatch.setattr(dpm_calibrate, name, number)
    assert run(dpm_calibrate, [weights, "-o", tmp_path / "out"]) == EXIT_OK
    assert len(set(kinds[:3])) == 3  # of towns for confidence; those for overlap are of any kind
    assert kinds[3:5] == ["corridor", "tunnel"]
    assert set(kinds[5:]) == {None}
    model = dpmjax.load_model(tmp_path / "out" / "model.safetensors")
    assert model.config.calibration is not None
    assert max(model.config.calibration.of_scans.weights[4:]) > 0
    assert min(model.config.calibration.of_weak_scans.weights) > 0
    metrics = load_json(tmp_path / "out" / "metrics.json")
    assert min(model.config.calibration.of_elements.weights) > 0
    assert metrics["brier_of_elements"] < metrics["brier_of_clouds"]
    assert metrics["brier_of_scans"] < metrics["brier_of_clouds"] < metrics["brier_of_a_constant_of_clouds"]
    assert model.config.overlap is not None
    assert metrics["num_overlap_pairs"] == 32
    assert 0 <= metrics["auc_overlap"] <= 1
    assert (tmp_path / "out" / "reliability_overlap.png").stat().st_size > 0
    assert (
        "Confidence calibrated on 3 towns and 2 ambiguous places, 300 pairs; overlap fitted on 2 towns, 32 pairs"
        in dpmjax.weights.read_card(tmp_path / "out" / "model.safetensors")
    )


def test_a_calibration_is_rated_by_what_it_is_sure_of() -> None:
    """Three sure registrations, of which one is wrong; clouds rest on features of their own."""
    of_scans = LogisticModel(SCAN_FEATURES, (0.0,) * 7 + (10.0, 0.0), 0.0)
    calibration = Calibration(LogisticModel(CLOUD_FEATURES, (0.0,) * 4, -5.0), of_scans)
    scores = [1.0, 1.0, 1.0, -1.0]
    row = {
        "of_clouds": [[0.0] * 4] * 4,
        "of_elements": [[0.0] * 8] * 3 + [None],
        "of_scans": [[0.0] * 7 + [score, 0.0] for score in scores],
        "of_weak_scans": [None] * 4,
        "lookalike_gap_of_elements": [None, None, 0.0, None],
        "lookalike_gap_of_scans": [None] * 4,
        "is_right": [True, True, False, False],
        "is_right_of_clouds": [False] * 4,
        "distance_m": [2.0, 8.0, 3.0, 4.0],
    }
    numbers = dpm_confidence.rate([row], calibration, "scans")
    assert (numbers["num_pairs"], numbers["num_sure"], numbers["num_sure_wrong"]) == (4, 3, 1)
    assert (numbers["num_near"], numbers["num_near_sure_right"]) == (3, 1)
    assert numbers["calibration_error"] == pytest.approx(0.25, abs=1e-3)
    assert dpm_confidence.rate([row], calibration, "clouds")["num_sure"] == 0
    sure = replace(calibration, of_elements=LogisticModel(ELEMENT_FEATURES, (0.0,) * 8, 5.0))
    assert dpm_confidence.rate([row], sure, "clouds")["num_sure"] == 2
    shared = dpm_confidence.rate([{**row, "lookalike_gap_of_scans": [0.0, None, None, None]}], calibration, "scans")
    assert shared["num_sure"] == 2
    lines = dpm_confidence.table([{"model": "m", "rated": "scans", "kind": "all", **numbers}]).splitlines()
    assert len({line.count("|") for line in lines}) == 1


@pytest.mark.slow
def test_half_of_the_overlap_pairs_of_drives_overlap(weights) -> None:
    drives = [toy.drive(1), toy.drive(2)]
    row = cli.measure_overlap(dpmjax.load_model(weights), drives, 32, 0)
    assert sum(row["is_overlap"]) == 16
    assert np.shape(row["evidence"]) == (32, len(OVERLAP_FEATURES))

"""The commands of the smaller experiments: options, tiny runs, resume."""

import numpy as np
import pytest

from dpmjax.cli.run import load_json
from dpmjax.deepmapping import preset, with_steps
from experiments import deepmapping_ablations, deepmapping_relocalize, deepmapping_rgbd, toy_1d
from tests.experiments.running import read_rows, run


@pytest.mark.slow
def test_toy_writes_its_picture_and_shares(tmp_path) -> None:
    out = tmp_path / "out"
    assert run(toy_1d, "--seeds", 4, "--steps", 3, "-o", out) == 0
    metrics = load_json(out / "metrics.json")
    assert metrics["x_global"] == pytest.approx(-1.417, abs=1e-3)
    assert len(metrics["share_at_global_minimum"]) == 5
    assert {row["initialization"] for row in read_rows(out)} >= {"xavier-relu", "pytorch"}
    assert (out / "toy.png").exists()


def test_the_chosen_seed_is_one_that_tells_the_story() -> None:
    x = -1.41707
    network = np.array([[0.0, 4.0], [9.0, x], [1.0, x], [2.0, x]])
    direct = np.array([[0.0, 4.0], [9.0, 8.9], [1.0, x], [2.0, 2.3]])
    assert toy_1d.choose_seed(network, direct) == 3


@pytest.mark.slow
def test_rgbd_resumes_walk_by_walk(tmp_path) -> None:
    out = tmp_path / "out"
    assert run(deepmapping_rgbd, "--limit", 1, "--methods", "zero", "-o", out) == 0
    first = read_rows(out)
    assert run(deepmapping_rgbd, "--resume", "-o", out, "--limit", 2) == 0
    rows = read_rows(out)
    assert rows[:1] == first
    assert [row["views"] for row in rows] == ["8", "16"]
    (summary,) = load_json(out / "metrics.json")["table"]
    assert summary["ate_m"] == pytest.approx(np.median([float(row["ate_m"]) for row in rows]))


def test_not_moving_is_never_right_on_hard_walks(tmp_path) -> None:
    out = tmp_path / "out"
    assert run(deepmapping_rgbd, "--walks", "hard", "--limit", 2, "--methods", "zero", "-o", out) == 0
    for row in read_rows(out):
        assert row["views"] == "16"
        assert float(row["ate_m"]) == pytest.approx(float(row["spread_m"]))
        assert float(row["spread_m"]) >= 0.45
        assert (row["success"], row["right"]) == ("False", "False")


def test_ablations_change_one_thing_each() -> None:
    basis = deepmapping_ablations.settings_of("lnet", "CNN", 600)
    for ablation, variants in deepmapping_ablations.VARIANTS.items():
        settings = [deepmapping_ablations.settings_of(ablation, variant, 600) for variant in variants]
        assert len(set(settings)) == len(variants)
        for one in settings:
            parts = ("localization", "occupancy", "cold_phases")
            changed = sum(getattr(one, part) != getattr(basis, part) for part in parts)
            assert changed <= (2 if ablation == "mnet" else 1)


@pytest.mark.slow
def test_relocalization_tells_known_from_right(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(deepmapping_relocalize, "NUM_SCANS", 32)
    monkeypatch.setattr(deepmapping_relocalize, "NUM_STEPS", 20)
    monkeypatch.setattr(deepmapping_relocalize.dm, "preset", lambda name, of=preset: with_steps(of(name), 20))
    out = tmp_path / "out"
    assert run(deepmapping_relocalize, "--stride-px", 160, "-o", out) == 0
    metrics, places = load_json(out / "metrics.json"), np.load(out / "places.npz")
    known, right = places["is_known"], places["errors_px"] < 20.0
    assert metrics["precision_of_known"] == (right[known].mean() if known.any() else None)
    ours = [row for row in metrics["table"] if row["method"] == "L-Net and M-Net"]
    assert sum(row["num_rows"] for row in ours) == len(known)

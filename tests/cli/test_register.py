"""The command that registers two scans, on a network that compiles in seconds."""

from unittest.mock import Mock

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli.program import main
from dpmjax.cli.register import verdict_numbers
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_OK, load_json
from dpmjax.io import read_lidar_file
from dpmjax.types import Registration
from tests.data_sets import read_ply, write_pcd
from tests.deeppointmap import toy


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    drive = toy.drive(num_scans=2)
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.MODEL), folder / "model.safetensors")
    write_pcd(folder / "a.pcd", drive.read_scan(0))
    np.save(folder / "b.npy", drive.read_scan(1))
    return folder


def command(files, *arguments) -> int:
    return main(["register", *map(str, arguments), "--weights", str(files / "model.safetensors")])


def test_files_hold_the_motion_that_the_library_finds(files, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert command(files, files / "a.pcd", files / "b.npy", "-o", out) == EXIT_OK
    source, target = read_lidar_file(files / "a.pcd"), read_lidar_file(files / "b.npy")
    model = dpmjax.load_model(files / "model.safetensors")
    expected = dpmjax.register(model, source, target, refine=True)
    T = np.loadtxt(out / "T_target_source.txt")
    np.testing.assert_allclose(T, expected.T_target_source, atol=1e-5)
    metrics = load_json(out / "metrics.json")
    np.testing.assert_allclose(metrics["T_target_source"], T, atol=1e-6)
    assert metrics["confidence"] == pytest.approx(float(expected.confidence), abs=1e-5)
    assert (out / "registration.png").stat().st_size > 1000
    aligned = read_ply(out / "aligned.ply")
    np.testing.assert_allclose(aligned[: len(source)], source @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    np.testing.assert_allclose(aligned[len(source) :], target, atol=1e-6)
    printed = capsys.readouterr().out
    assert "maps points of a.pcd to the frame of b.npy" in printed
    # The network is untrained, so its score is no probability.
    assert metrics["is_calibrated"] is False
    assert "(these weights are not calibrated)" in printed
    assert "probability" not in printed


def test_an_earlier_run_is_replaced_only_on_demand(files, tmp_path, capsys) -> None:
    arguments = (files / "a.pcd", files / "b.npy", "--no-refine", "-o", tmp_path / "out")
    assert command(files, *arguments) == EXIT_OK
    assert command(files, *arguments) == EXIT_BAD_INPUT
    assert "--force" in capsys.readouterr().err
    assert command(files, *arguments, "--force") == EXIT_OK


@pytest.mark.parametrize(
    ("name", "message"), [("model.safetensors", "unknown kind of scan"), (".", "a folder; give one scan file")]
)
def test_bad_input_is_one_line_and_leaves_no_folder(files, refused, name, message) -> None:
    assert message in refused("register", files / name, files / "b.npy")


@pytest.mark.slow
def test_columns_of_raw_files_are_judged_said_and_noted(files, tmp_path, capsys) -> None:
    paths = [tmp_path / "a.pcd.bin", tmp_path / "b.pcd.bin"]
    rng = np.random.default_rng(0)
    for path, points in zip(paths, (read_lidar_file(files / "a.pcd"), read_lidar_file(files / "b.npy")), strict=True):
        more = np.column_stack([rng.integers(0, 255, len(points)), rng.integers(0, 32, len(points))])
        np.column_stack([points, more]).astype("<f4").tofile(path)
    assert command(files, *paths, "--no-refine", "-o", tmp_path / "out") == EXIT_OK
    notes = load_json(tmp_path / "out" / "metrics.json")["input_notes"]
    assert [("5 columns a point" in note) for note in notes] == [True, True]
    assert all(note in (tmp_path / "out" / "log.txt").read_text() for note in notes)
    assert command(files, *paths, "--no-refine", "--columns", "5", "-o", tmp_path / "other") == EXIT_OK
    assert load_json(tmp_path / "other" / "metrics.json")["input_notes"] == []


def test_scans_of_a_handful_of_points_have_no_result(files, tmp_path, capsys) -> None:
    np.save(tmp_path / "few.npy", np.eye(3, dtype=np.float32) * 5)
    out = tmp_path / "out"
    assert command(files, tmp_path / "few.npy", files / "b.npy", "-o", out) == EXIT_FAILED
    assert "no motion was found, the identity was written" in capsys.readouterr().err
    assert load_json(out / "metrics.json")["status"] == "failed"
    np.testing.assert_array_equal(np.loadtxt(out / "T_target_source.txt"), np.eye(4))


@pytest.mark.parametrize(
    ("num_inliers", "confidence", "is_calibrated", "status"),
    [(9, 0.95, True, "done"), (9, 0.5, True, "uncertain"), (9, 0.5, False, "done"), (0, 0.95, True, "failed")],
)
def test_status_and_verdict_follow_from_the_confidence(num_inliers, confidence, is_calibrated, status) -> None:
    found = Mock(Registration, verification=None, num_inliers=num_inliers, confidence=confidence, relative_size=None)
    numbers = verdict_numbers(found, is_calibrated)
    assert numbers["status"] == status
    assert ("NOT SURE" in numbers["verdict"]) == (status == "uncertain")

"""The command that finds scans in a saved map, on a network that compiles in seconds."""

from __future__ import annotations

import os
import signal

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli import localize
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_FAILED, EXIT_OK
from dpmjax.cli.run_folder import load_json
from dpmjax.cli.slam_results import localization_errors
from dpmjax.geometry import rigid
from dpmjax.io import open_lidar_sequence, read_poses
from dpmjax.slam import Match, NetworkMatcher, Submap, make_methods
from tests.data_sets import run_in, write_kitti_sequence
from tests.deeppointmap import toy

# T_lidar_camera: the camera looks along its z axis.
AXES = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Weights, a map of the first scans of a drive, and a folder with all of them."""
    folder = tmp_path_factory.mktemp("case")
    drive = toy.drive(num_scans=6, step_m=1.9)
    model = dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL)
    dpmjax.save_model(model, folder / "model.safetensors")
    result = dpmjax.run_slam(model, [drive.read_scan(number) for number in range(4)])
    dpmjax.save_map(folder / "map.npz", result.map)
    write_kitti_sequence(folder / "kitti", "00", drive)
    np.save(folder / "poses.npy", drive.T_world_lidar)
    np.save(folder / "camera.npy", rigid.inverse(AXES) @ drive.T_world_lidar @ AXES)
    return folder


def run(*arguments) -> int:
    return main(["localize", *map(str, arguments)])


def scans_of(case):
    return next(path.parent for path in case.glob("**/velodyne"))


@pytest.fixture
def with_truth(case, monkeypatch) -> None:
    """Registers scans by their true poses, surely except the last one, because the networks are untrained."""
    methods = make_methods(dpmjax.load_model(case / "model.safetensors"))
    drive, truth = open_lidar_sequence(scans_of(case)), np.load(case / "poses.npy")

    def described(number: int) -> np.ndarray:
        scan = methods.geometry.thin(drive.read_points(number))
        return methods.matcher.vector(methods.matcher.encode(scan))

    vectors = np.array([described(number) for number in range(len(truth))])

    def number_of(submap: Submap) -> int:
        vector = methods.matcher.vector(submap.scans[0])
        return int(np.argmin(np.linalg.norm(vectors - vector, axis=1)))

    def register(self, pairs: list[tuple[Submap, Submap]]) -> list[Match]:
        numbers = [(number_of(source), number_of(target)) for source, target in pairs]
        return [
            Match(rigid.inverse(truth[target]) @ truth[source], 0.0 if source == len(truth) - 1 else 0.99, 0.1)
            for source, target in numbers
        ]

    monkeypatch.setattr(NetworkMatcher, "register", register)


def test_every_scan_gets_a_row_and_a_resumed_run_equals_an_unbroken_one(case, with_truth, tmp_path, capsys) -> None:
    weights = ("--weights", case / "model.safetensors")
    out = tmp_path / "out"
    arguments = (case / "map.npz", scans_of(case), *weights, "--map-poses", case / "poses.npy", "-o", out)
    assert run(*arguments) == EXIT_OK
    printed = capsys.readouterr().out
    assert "5 of 6 scans found" in printed
    assert "these weights are not calibrated" in printed
    table = out / "localizations.csv"
    rows = run_in(out).read_table(table.name)
    assert [row["scan"] for row in rows] == list(map(str, range(6)))
    metrics = load_json(out / "metrics.json")
    assert metrics["num_inside"] == 6
    assert metrics["is_calibrated"] is False
    assert (metrics["num_found"], metrics["num_right"], metrics["num_wrong"]) == (5, 5, 0)
    assert metrics["median_error_m"] < 1e-3
    assert (out / "map.png").stat().st_size > 0
    assert [row["status"] for row in rows] == [*["found"] * 5, "not in this map"]
    slam_map, truth = dpmjax.load_map(case / "map.npz"), np.load(case / "poses.npy")
    T_keyframe_scan = [rigid.inverse(truth[int(row["keyframe_scan"])]) @ truth[i] for i, row in enumerate(rows[:5])]
    expected = slam_map.T_world_keyframe[[int(row["keyframe"]) for row in rows[:5]]] @ T_keyframe_scan
    np.testing.assert_allclose(read_poses(out / "trajectory_tum.txt"), expected, atol=1e-5)
    # The run is cut off in the middle of a row.
    text = table.read_text()
    cut = text.splitlines(keepends=True)
    table.write_text("".join(cut[:4]) + cut[4][:9])
    assert run("--resume", "-o", out) == EXIT_OK
    without_time = [{**row, "seconds": ""} for row in run_in(out).read_table(table.name)]
    assert without_time == [{**row, "seconds": ""} for row in rows]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"map": "none.npz"}, "none.npz: no such file"),
        ({"map": "poses.npy"}, "not one of a dpmjax map"),
        ({"scans": "nowhere"}, "nowhere"),
        ({"weights": "no_such_model"}, "no_such_model"),
        ({"map_poses": "none.npy"}, "none.npy"),
        ({"map_poses": "camera.npy"}, "motions between keyframes differ by"),
        ({"weights": "other.safetensors"}, "name the weights that made it with --weights"),
        ({"weights": "other.safetensors"}, "/other.safetensors ("),
    ],
)
def test_bad_input_is_told_in_one_line(case, refused, changes, message) -> None:
    other = case / "other.safetensors"
    if not other.exists():
        dpmjax.save_model(dpmjax.init_model(jax.random.key(1), toy.SLAM_MODEL), other)
    given = {"map": "map.npz", "weights": "model.safetensors", "map_poses": "poses.npy", **changes}
    scans = case / given["scans"] if "scans" in given else scans_of(case)
    weights = given["weights"] if given["weights"] == "no_such_model" else case / given["weights"]
    arguments = (case / given["map"], scans, "--weights", weights, "--map-poses", case / given["map_poses"])
    assert message in refused("localize", *arguments)


def test_errors_are_those_of_the_keyframes_frames(case) -> None:
    slam_map = dpmjax.load_map(case / "map.npz")
    drive = open_lidar_sequence(scans_of(case), poses=case / "poses.npy")
    reference = np.load(case / "poses.npy")[[keyframe.scan for keyframe in slam_map.keyframes]]
    T = slam_map.T_world_keyframe[0] @ np.linalg.inv(reference[0]) @ drive.T_world_lidar[1]
    found = []
    for shift_m, is_found in ((0.0, True), (3.0, True), (0.5, True), (0.0, False)):
        moved = T.copy()
        moved[0, 3] += shift_m
        evidence = (0.9, 0, "numbers") if is_found else (0.0, None, "numbers")
        status = "found" if is_found else "not in this map"
        found.append(dpmjax.Localization(status, moved if is_found else None, *evidence))
    errors = localization_errors(found, slam_map, reference, drive.T_world_lidar[[1, 1, 1, 1]])
    np.testing.assert_array_equal(errors.is_right, [True, False, True, False])
    np.testing.assert_array_equal(errors.is_found, [True, True, True, False])
    np.testing.assert_allclose(errors.translation_m[:3], [0, 3, 0.5], atol=1e-6)
    # The table of a run that goes on holds the same results.
    inputs = localize.Case(slam_map, drive, None, True)
    rows = [localize.as_row(inputs, one, 0.1) for one in found]
    again = localization_errors(
        list(map(localize.as_localization, rows)), slam_map, reference, drive.T_world_lidar[[1, 1, 1, 1]]
    )
    np.testing.assert_allclose(again.translation_m, errors.translation_m, atol=1e-6)


@pytest.mark.slow
def test_a_stopped_run_is_interrupted(case, tmp_path, monkeypatch) -> None:
    def stopped(*arguments):
        for result in localize_each(*arguments):
            os.kill(os.getpid(), signal.SIGINT)
            yield result

    localize_each = localize.slam.localize_each
    monkeypatch.setattr("dpmjax.slam.localize_each", stopped)
    arguments = (case / "map.npz", scans_of(case), "--weights", case / "model.safetensors", "-o", tmp_path / "out")
    assert run(*arguments) == 130
    assert load_json(tmp_path / "out" / "metrics.json")["status"] == "interrupted"


def test_a_damaged_scan_leaves_the_results_so_far(case, tmp_path, capsys) -> None:
    scans, out = tmp_path / "scans", tmp_path / "out"
    scans.mkdir()
    drive = open_lidar_sequence(scans_of(case))
    for number in range(2):
        np.save(scans / f"{number}.npy", drive.read_points(number))
    (scans / "1.npy").write_bytes((scans / "1.npy").read_bytes()[:-30])
    arguments = (case / "map.npz", scans, "--weights", case / "model.safetensors", "-o", out)
    assert run(*arguments) == EXIT_FAILED
    assert "1.npy" in capsys.readouterr().err.splitlines()[-1]
    assert load_json(out / "metrics.json")["num_scans"] == 1
    assert (out / "trajectory_tum.txt").exists()


def test_scans_without_points_are_a_failure(case, tmp_path, capsys) -> None:
    """The map is fine; nothing could be looked for."""
    scans, out = tmp_path / "scans", tmp_path / "out"
    scans.mkdir()
    for number in range(3):
        np.save(scans / f"{number}.npy", np.zeros((50, 3), np.float32))
    arguments = (case / "map.npz", scans, "--weights", case / "model.safetensors", "-o", out)
    assert run(*arguments) == EXIT_FAILED
    last = capsys.readouterr().err.replace("\r", "\n").splitlines()[-1]
    assert "3 of 3 scans without enough points" in last
    assert load_json(out / "metrics.json")["status"] == "failed"

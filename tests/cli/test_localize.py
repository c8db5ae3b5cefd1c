"""The command that finds scans in a saved map, on a network that compiles in seconds."""

from pathlib import Path

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_FAILED, EXIT_OK, load_json
from dpmjax.geometry import rigid
from dpmjax.io import open_lidar_sequence, read_poses
from dpmjax.slam import Match, NetworkMatcher, Submap, make_methods
from tests.data_sets import run_in, write_kitti_sequence
from tests.deeppointmap import toy


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
    arguments = (case / "map.npz", scans_of(case), *weights, "-o", out)
    assert run(*arguments) == EXIT_OK
    printed = capsys.readouterr().out
    assert "5 of 6 scans found" in printed
    assert "these weights are not calibrated" in printed
    table = out / "localizations.csv"
    rows = run_in(out).read_table(table.name)
    assert [row["scan"] for row in rows] == list(map(str, range(6)))
    metrics = load_json(out / "metrics.json")
    assert metrics["is_calibrated"] is False
    assert metrics["num_found"] == 5
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
        ({"map": "poses.npy"}, "not one of a dpmjax map"),
        ({"scans": "nowhere"}, "nowhere"),
        ({"weights": "other.safetensors"}, "name the weights that made it with --weights"),
    ],
)
def test_bad_input_is_told_in_one_line(case, refused, changes, message) -> None:
    other = case / "other.safetensors"
    if not other.exists():
        dpmjax.save_model(dpmjax.init_model(jax.random.key(1), toy.SLAM_MODEL), other)
    given = {"map": "map.npz", "weights": "model.safetensors", **changes}
    scans = case / given["scans"] if "scans" in given else scans_of(case)
    assert message in refused("localize", case / given["map"], scans, "--weights", case / given["weights"])


def run_on(case, folder: Path, *scans: np.ndarray) -> int:
    (folder / "scans").mkdir()
    for number, scan in enumerate(scans):
        np.save(folder / "scans" / f"{number}.npy", scan)
    return run(case / "map.npz", folder / "scans", "--weights", case / "model.safetensors", "-o", folder / "out")


def test_a_damaged_scan_leaves_the_results_so_far(case, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert (
        run_on(case, tmp_path, open_lidar_sequence(scans_of(case)).read_points(0), np.array(["damaged"])) == EXIT_FAILED
    )
    assert "1.npy" in capsys.readouterr().err.splitlines()[-1]
    assert load_json(out / "metrics.json")["num_scans"] == 1
    assert (out / "trajectory_tum.txt").exists()


def test_scans_without_points_are_a_failure(case, tmp_path, capsys) -> None:
    """The map is fine; nothing could be looked for."""
    assert run_on(case, tmp_path, *[np.zeros((50, 3), np.float32)] * 3) == EXIT_FAILED
    last = capsys.readouterr().err.replace("\r", "\n").splitlines()[-1]
    assert "3 of 3 scans without enough points" in last
    assert load_json(tmp_path / "out" / "metrics.json")["status"] == "failed"

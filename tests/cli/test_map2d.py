"""`dpmjax map2d`: whole runs on tiny scans and answers to bad input; the input of `dpmjax depth`."""

import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from PIL import Image

from dpmjax.cli.depth import DepthOptions, read_images
from dpmjax.cli.map2d import Map2dOptions, fit_settings, main, trust_verdict
from dpmjax.cli.run import Run, load_json, run_command
from dpmjax.io import InputError, ScanSequence
from dpmjax.simulation import simulate_sequence
from dpmjax.slam import register_scans
from tests.data_sets import write_deepmapping_folder
from tests.processes import run_python

NUM_SCANS = 16
SCALE_M = 0.05
METRICS = (
    "ate_px", "ate_initial_px", "point_distance_px", "point_distance_initial_px", "num_scans", "steps", "wall_s",
    "compile_s", "peak_rss_gb", "success", "seed",
)  # fmt: skip


@pytest.fixture(scope="module")
def walk() -> ScanSequence:
    return simulate_sequence(0, NUM_SCANS, num_beams=64)


@pytest.fixture(scope="module")
def scans_npz(walk, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "scans.npz"
    np.savez(path, points=np.where(walk.mask[..., None], walk.points, 0.0), poses=walk.reference_poses)
    return path


@pytest.mark.parametrize(
    ("preset", "unit", "expected"), [("paper", "px", 512.0), ("paper", "m", None), ("fast", "px", None)]
)
def test_unit_of_the_fit_is_that_of_the_worlds_of_the_paper(walk, preset, unit, expected) -> None:
    assert fit_settings(Map2dOptions(preset=preset), replace(walk, unit=unit)).unit == expected


def run(*options: object, interrupt: bool = False) -> subprocess.CompletedProcess[str]:
    """Runs the command in a process of its own; `interrupt` stops it after the first call of the step."""
    code = (
        "import os, signal; from dpmjax.cli import map2d as m; from dpmjax.cli.run import Run, load_json, run_command\n"
        "append = Run.append_row\n"
        "Run.append_row = lambda *a, **k: (append(*a, **k), os.kill(os.getpid(), signal.SIGINT))\n"
        "raise SystemExit(run_command(m.main, name='map2d', description=None))"
    )
    return run_python(*(("-c", code) if interrupt else ("-m", "dpmjax", "map2d")), *options)


@pytest.mark.slow
def test_a_run_on_the_authors_folder_writes_everything_it_promises(walk, tmp_path) -> None:
    folder = write_deepmapping_folder(tmp_path / "scans", walk)
    np.save(tmp_path / "start.npy", walk.reference_poses + np.array([3.0, -2.0, 0.0]))
    done = run(folder, "-o", tmp_path / "out", "--steps", 20, "--init", tmp_path / "start.npy")
    assert done.returncode == 0, done.stderr
    metrics = load_json(tmp_path / "out" / "metrics.json")
    assert not [name for name in METRICS if metrics.get(name) is None]
    assert (metrics["num_scans"], metrics["steps"], metrics["success"]) == (NUM_SCANS, 20, True)
    assert metrics["status"] == ("done" if metrics["assessment"]["is_trusted"] else "uncertain")
    # From a good start it never gets worse.
    assert metrics["ate_initial_px"] < 1e-3
    assert metrics["ate_px"] < 0.1
    assert load_json(tmp_path / "out" / "config.json")["steps"] == 20
    candidates = metrics["candidates"]
    # A fit that lies where the refined start lies is not refined again.
    assert list(candidates)[:3] == ["poses of start.npy", "DeepMapping", "poses of start.npy, refined"]
    assert candidates[metrics["kept"]]["ate_px"] == metrics["ate_px"]
    assert candidates["poses of start.npy"]["ate_px"] == metrics["ate_initial_px"]
    assert min(numbers["misfit"] for numbers in candidates.values()) == candidates[metrics["kept"]]["misfit"]
    assert f"kept: {metrics['kept']}" in done.stdout
    for name in ("map.png", "occupancy.png", "loss.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG"), name
    assert len(np.load(tmp_path / "out" / "trajectory.npy")) == NUM_SCANS
    tum = file_interface.read_tum_trajectory_file(tmp_path / "out" / "trajectory_tum.txt")
    kitti = file_interface.read_kitti_poses_file(tmp_path / "out" / "trajectory_kitti.txt")
    np.testing.assert_allclose(tum.positions_xyz, kitti.positions_xyz, atol=1e-4)
    assert tum.num_poses == NUM_SCANS


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_to_the_same_numbers(scans_npz, tmp_path) -> None:
    options = (scans_npz, "--steps", 60, "--no-refine", "--init", "zero")
    broken = run(*options, "-o", tmp_path / "broken", interrupt=True)
    assert broken.returncode == 130, broken.stderr
    stopped = load_json(tmp_path / "broken" / "metrics.json")
    assert stopped["status"] == "interrupted"
    assert 0 < stopped["steps"] < 60
    assert list(stopped["candidates"]) == ["zero poses", "DeepMapping"]
    resumed = run("--resume", "-o", tmp_path / "broken")
    assert resumed.returncode == 0, resumed.stderr
    unbroken = run(*options, "-o", tmp_path / "unbroken")
    assert unbroken.returncode == 0, unbroken.stderr
    assert (
        load_json(tmp_path / "broken" / "metrics.json")["steps"]
        == load_json(tmp_path / "unbroken" / "metrics.json")["steps"]
    )
    one, other = (np.load(tmp_path / name / "trajectory.npy") for name in ("broken", "unbroken"))
    np.testing.assert_array_equal(one, other)
    rows = [(tmp_path / name / "metrics.csv").read_text().splitlines() for name in ("broken", "unbroken")]
    assert [row.split(",")[0] for row in rows[0]] == [row.split(",")[0] for row in rows[1]]


@pytest.mark.slow
def test_a_run_interrupted_before_the_fit_keeps_its_start(scans_npz, tmp_path, monkeypatch) -> None:
    def interrupted(*options: object, **hooks: object) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        return register_scans(*options, **hooks)  # type: ignore[arg-type]

    monkeypatch.setattr("dpmjax.slam.register_scans", interrupted)
    arguments = [str(scans_npz), "--init", "zero", "-o", str(tmp_path / "out")]
    assert run_command(main, name="map2d", description=None, args=arguments) == 130
    found = load_json(tmp_path / "out" / "metrics.json")
    assert found["status"] == "interrupted"
    assert (found["steps"], found["kept"]) == (0, "zero poses")
    assert list(found["candidates"]) == ["zero poses"]
    assert (tmp_path / "out" / "map.png").exists()
    assert not (tmp_path / "out" / "occupancy.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("is_ordered", "noise_px"), [(True, 0.0), (False, 2.0)])
def test_a_global_start_finds_the_map_from_half_a_turn_of_view(tmp_path, is_ordered, noise_px) -> None:
    """In metres, with 180 degrees of view: in order and without noise, and shuffled with 0.1 m of range noise."""
    walk = simulate_sequence(0, 24, num_beams=180, seed=3, range_noise_px=noise_px)
    order = np.arange(0, 24, 2) if is_ordered else np.random.default_rng(0).permutation(np.arange(0, 24, 2))
    bearing_deg = (2 * np.arange(180) + 180) % 360 - 180
    ahead = [beam for beam in np.argsort(bearing_deg) if abs(bearing_deg[beam]) <= 90]
    points = np.where(walk.mask[..., None], walk.points, 0.0)[order][:, ahead] * SCALE_M
    poses = walk.reference_poses[order] * [SCALE_M, SCALE_M, 1.0]
    np.savez(tmp_path / "half.npz", points=points, poses=poses, unit="m")
    assert points[..., 0].min() > -1e-3  # nothing from behind
    options = [] if is_ordered else ["--no-ordered"]
    done = run(tmp_path / "half.npz", "-o", tmp_path / "out", "--init", "global", "--steps", 20, *options)
    assert done.returncode == 0, done.stderr
    metrics = load_json(tmp_path / "out" / "metrics.json")
    candidates = metrics["candidates"]
    # The walk spans some metres: a tenth of a metre is right, and no wall is doubled.
    assert candidates["global registration"]["ate_m"] < 0.1
    assert metrics["ate_m"] < (0.01 if is_ordered else 0.1)
    assert metrics["assessment"]["is_trusted"]


@pytest.mark.slow
def test_odometry_that_leads_astray_is_not_the_only_start(tmp_path, monkeypatch) -> None:
    drive = simulate_sequence(0, 24, num_beams=128, with_odometry=True)
    astray = np.random.default_rng(0).normal(size=(24, 3)) * [200.0, 200.0, 1.0]
    drive = replace(drive, odometry_poses=astray)
    monkeypatch.setattr("dpmjax.cli.map2d.read_scans", lambda _config: drive)
    options = Map2dOptions(steps=2, output=tmp_path / "out")
    found = main(options, Run("map2d", options))
    assert found["start"] == "odometry"
    assert found["kept"] == "incremental ICP, point to line, refined"
    assert found["assessment"]["is_trusted"]
    assert found["ate_px"] < 0.1


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda points: 0 * points, "scans.npy"),
        (lambda points: np.nan * points, "scans.npy"),
        (lambda points: points[:1], "scan"),
        (lambda points: np.tile(points[:1], (NUM_SCANS, 1, 1)), "all scans are equal"),
    ],
)
def test_scans_without_a_valid_beam_or_all_equal_are_refused(as_user, walk, tmp_path, refused, spoil, found) -> None:
    np.save(tmp_path / "scans.npy", spoil(np.where(walk.mask[..., None], walk.points, 0.0)))
    assert found in refused("map2d", tmp_path / "scans.npy")


@pytest.mark.parametrize(
    ("init", "found"), [("odometry", "no odometry"), ("guess", "--init guess"), ("x.npy", "x.npy")]
)
def test_a_start_that_is_not_there_is_named(as_user, scans_npz, refused, init, found) -> None:
    assert found in refused("map2d", scans_npz, "--init", init)


@pytest.mark.parametrize(("rows", "spans"), [([4], "4"), ([3, 4, 5, 9], "3-5, 9"), ([0, 2, 3], "0, 2-3")])
def test_the_verdict_names_the_uncertain_scans_and_the_fault(rows: list[int], spans: str) -> None:
    assessment = {"is_trusted": False, "weakest_connection": 0.3, "contradiction": 0.01}
    text = trust_verdict(assessment | {"uncertain_scans": rows, "fault": "the scans are mirrored"})
    assert "DO NOT TRUST" in text
    assert text.endswith(f" {spans}")
    assert "the scans are mirrored" in text


def test_a_blank_image_is_named(tmp_path) -> None:
    np.savetxt(tmp_path / "intrinsics.txt", [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    for name, depth_mm in (("1", 2000), ("2", 0), ("3", 2000)):
        Image.fromarray(np.full((48, 64), depth_mm, np.uint16)).save(tmp_path / f"{name}.depth.png")
    with pytest.raises(InputError, match=r"2\.depth\.png: no pixel measures up to .* leave out such images, 1 of 3"):
        read_images(DepthOptions(data=tmp_path))


def test_a_folder_without_images_is_refused_and_a_selection_is_taken(tmp_path) -> None:
    with pytest.raises(InputError, match="0 .depth.png files"):
        read_images(DepthOptions(data=tmp_path))
    assert len(read_images(DepthOptions(n_scans=2, jump=2))) == 2

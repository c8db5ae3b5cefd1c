"""Options of `dpmjax slam`: saved maps are extended, scans deskewed, and the viewer records."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli import slam
from dpmjax.cli.drives import DriveOptions, ScanReader, open_drive, with_raised_beams
from dpmjax.cli.info import why_not_importable
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_OK, load_json
from dpmjax.io import write_tum
from dpmjax.scan import offsets_by_azimuth
from dpmjax.slam import SlamConfig, slam_preset
from tests.cli.test_slam import run, use_truth, write_drive
from tests.deeppointmap import toy
from tests.slam.test_odometry import motion, planes, seen_from


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> tuple[Path, Path]:
    """A walk through a room, with a corner and back, and a network that compiles in seconds."""
    folder = tmp_path_factory.mktemp("room")
    rng = np.random.default_rng(0)
    (folder / "drive").mkdir()
    truth = np.array([motion(0.5 * step, 0.0, 3.0 * step) for step in [*range(12), *range(11, 3, -1)]])
    for number, T in enumerate(truth):
        np.save(folder / "drive" / f"{number}.npy", seen_from(planes(rng), T).astype(np.float32))
    write_tum(folder / "drive" / "poses_lidar.txt", truth)
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL), folder / "toy.safetensors", card="toy")
    return folder / "drive", folder / "toy.safetensors"


def test_a_drive_of_fewer_scans_than_wanted_is_noted(room) -> None:
    def notes(**options):
        drive = open_drive(room[0], DriveOptions(**options))
        return [note.text for note in drive.notes if "fewer" in note.text]

    assert notes(n_scans=50, jump=3) == ["drive: 7 scans at --jump 3, fewer than --n-scans 50"]
    assert notes(n_scans=50) == ["drive: 20 scans, fewer than --n-scans 50"]
    assert not notes(n_scans=7, jump=3)
    assert not notes()


@pytest.mark.slow
def test_a_saved_map_is_extended(room, tmp_path, refused) -> None:
    drive, weights = room
    first, second = tmp_path / "first", tmp_path / "second"
    assert run(drive, "--weights", weights, "-n", 8, "-o", first) == EXIT_OK
    before = dpmjax.load_map(first / "map.npz")
    assert run(drive, "--weights", weights, "--map", first / "map.npz", "-o", second) == EXIT_OK
    after = dpmjax.load_map(second / "map.npz")
    assert len(after) > len(before)
    assert [keyframe.scan for keyframe in after.keyframes][: len(before)] == [k.scan for k in before.keyframes]
    assert len(np.load(second / "trajectory.npy")) == 20
    # The state of the second run holds the map, too.
    for name in ("trajectory.npy", "map.npz", "loops.csv"):
        (tmp_path / name).write_bytes((second / name).read_bytes())
    assert run("--resume", "-o", second) == EXIT_OK
    for name in ("trajectory.npy", "map.npz", "loops.csv"):
        assert (tmp_path / name).read_bytes() == (second / name).read_bytes()
    other = tmp_path / "other.safetensors"
    dpmjax.save_model(dpmjax.init_model(jax.random.key(1), toy.SLAM_MODEL), other, card="toy")
    for options, message in (
        (["--map", first / "map.npz", "--weights", other], "made with weights"),
        (["--map", first / "config.json", "--weights", weights], "config.json"),
        (["--map", tmp_path / "none.npz", "--weights", weights], "no such file"),
    ):
        assert message in refused("slam", drive, *options)


@pytest.mark.slow
def test_deskewing_and_odometry_alone_are_options(room, tmp_path) -> None:
    drive, weights = room
    assert run(drive, "--weights", weights, "--deskew", "--no-loop", "-n", 6, "-o", tmp_path / "out") == EXIT_OK
    metrics = load_json(tmp_path / "out" / "metrics.json")
    assert metrics["loop_statuses"] == {}
    assert metrics["ate_m"] == pytest.approx(metrics["ate_odometry_m"])


def test_options_of_odometry_and_loops_reach_the_settings(room) -> None:
    _, weights = room
    given = slam.slam_methods(slam.SlamOptions(weights=str(weights), odometry="network", no_loop=True))
    assert given.config.odometry.proposer == "network"
    assert not given.config.loops.is_on
    assert slam.slam_methods(slam.SlamOptions(weights=str(weights))).config == SlamConfig()
    paper = slam.slam_methods(slam.SlamOptions(weights=str(weights), preset="paper", no_loop=True)).config
    assert paper == replace(slam_preset("paper"), loops=given.config.loops)


@pytest.mark.parametrize("times", [None, (0.0, 0.2, 0.4, 0.8)])
def test_times_of_points_come_before_their_azimuths(tmp_path, times) -> None:
    points = np.random.default_rng(0).normal(size=(30, 3)) * 10
    for number in range(4):
        np.savez(tmp_path / f"{number}.npz", points=points, times=np.linspace(0.0, 0.1, 30))
    if times:
        (tmp_path / "times.txt").write_text("".join(f"{time}\n" for time in times))
    reader = ScanReader(dpmjax.io.open_lidar_sequence(tmp_path), is_deskewed=True)
    # Shares of the time between the two scans before: 0.2 s where it is known, else that of the turn.
    share = 0.5 if times else 1.0
    np.testing.assert_allclose(reader(3).offsets, share * np.linspace(-0.5, 0.5, 30), atol=1e-6)
    np.savez(tmp_path / "3.npz", points=points, times=np.zeros(30))
    np.testing.assert_allclose(reader(3).offsets, offsets_by_azimuth(reader(3).points, share), atol=1e-6)


def test_kittis_beams_are_raised(tmp_path) -> None:
    np.save(tmp_path / "0.npy", [[10.0, 0.0, 0.0], [0.0, 20.0, 1.0]])
    sequence = with_raised_beams(dpmjax.io.open_lidar_sequence(tmp_path))
    np.testing.assert_allclose(sequence.read_scan(0)[0], [10.0, 0.0, 10 * np.radians(0.205)], atol=1e-3)


def test_a_selection_is_every_nth_scan_of_its_reference(tmp_path) -> None:
    drive = write_drive(tmp_path / "drive")
    part = open_drive(drive, DriveOptions(jump=3, n_scans=4))
    assert [Path(source).stem for source in part.sources] == ["000", "003", "006", "009"]
    whole = dpmjax.io.open_lidar_sequence(drive)
    np.testing.assert_array_equal(part.T_world_lidar, whole.T_world_lidar[:12:3])


def test_the_viewer_records_where_there_is_no_screen(tmp_path, monkeypatch, capsys) -> None:
    use_truth(monkeypatch)
    drive = write_drive(tmp_path / "drive")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if why_not_importable("rerun") is not None:
        assert run(drive, "-v", "-n", 30, "-o", tmp_path / "out") == EXIT_BAD_INPUT
        assert "dpmjax[viewer]" in capsys.readouterr().err
        return
    assert run(drive, "-v", "-n", 30, "-o", tmp_path / "out") == EXIT_OK
    assert (tmp_path / "out" / "slam.rrd").stat().st_size > 1000

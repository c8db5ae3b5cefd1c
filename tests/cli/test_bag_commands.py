"""Commands on bags of ROS: the same results as on files, topics, and notes."""

from pathlib import Path

import numpy as np
import pytest

from dpmjax.cli import map2d
from dpmjax.cli.run import EXIT_OK, load_json
from tests.cli.test_slam import run
from tests.data_sets import write_pcd
from tests.experiments.running import read_rows
from tests.io.bag_files import EPOCH_NS, KINDS, BagWriter
from tests.slam.test_odometry import motion, planes, seen_from

NUM, STEP_NS = 5, 100_000_000


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    world = planes(np.random.default_rng(0))
    return [seen_from(world, motion(0.4 * step, 0, 0)).astype(np.float32) for step in range(NUM)]


def write_bag(path: Path, kind: str, scans: list[np.ndarray]) -> Path:
    with BagWriter(path, kind) as bag:
        for index, points in enumerate(scans):
            stamp = EPOCH_NS + index * STEP_NS
            bag.write_cloud(points, stamp, layout="velodyne", times_s=np.linspace(0, 0.1, len(points)))
            bag.write_scan(np.full(40, 3.0) + 0.1 * index, stamp)
    return bag.path


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != KINDS[0])) for kind in KINDS])
def test_slam_maps_a_bag_as_it_maps_files(tmp_path: Path, without_networks, scans, kind: str) -> None:
    (tmp_path / "files").mkdir()
    for index, points in enumerate(scans):
        write_pcd(tmp_path / "files" / f"{index}.pcd", points)
    bag = write_bag(tmp_path / "drive", kind, scans)
    assert run(tmp_path / "files", "-o", tmp_path / "a") == EXIT_OK
    assert run(bag, "-o", tmp_path / "b") == EXIT_OK
    of_files, of_bag = (np.load(tmp_path / name / "trajectory.npy") for name in "ab")
    np.testing.assert_array_equal(of_files, of_bag)
    stamps = np.loadtxt(tmp_path / "b" / "trajectory_tum.txt")[:, 0]
    np.testing.assert_allclose(stamps, 1.6e9 + 0.1 * np.arange(NUM), atol=1e-5)
    assert [row["status"] for row in read_rows(tmp_path / "b", "scans.csv")] == ["first", *["tracked"] * (NUM - 1)]
    assert load_json(tmp_path / "b" / "metrics.json")["status"] == "done"
    assert run("--resume", "-o", tmp_path / "b") == EXIT_OK


def test_scans_of_a_bag_are_deskewed_by_their_times(tmp_path: Path, without_networks, scans) -> None:
    bag = write_bag(tmp_path / "drive", "mcap", scans)
    assert run(bag, "--deskew", "--topic", "/points", "-o", tmp_path / "a") == EXIT_OK


@pytest.mark.parametrize("command", ["slam", "map2d"])
def test_a_topic_that_is_not_there_is_one_line(tmp_path, scans, refused, command: str) -> None:
    bag = write_bag(tmp_path / "drive", "bag", scans)
    line = refused(command, bag, "--topic", "/none")
    assert "no topic /none, it has /points (PointCloud2), /scan (LaserScan)" in line


def test_map2d_reads_the_planar_scans_of_the_same_bag(tmp_path: Path, scans) -> None:
    bag = write_bag(tmp_path / "drive", "db3", scans)
    sequence = map2d.read_scans(map2d.Map2dOptions(data=bag, jump=2))
    assert len(sequence) == 3
    np.testing.assert_allclose(np.linalg.norm(sequence.points, axis=2)[:, 0], [3.0, 3.2, 3.4], rtol=1e-6)

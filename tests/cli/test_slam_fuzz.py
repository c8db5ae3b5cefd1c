"""Broken drives: `dpmjax slam` ends with results, or with one line and an exit code, never with a traceback."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dpmjax import model_preset
from dpmjax.cli import slam, slam_run
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_OK
from dpmjax.io import write_kitti, write_tum
from dpmjax.slam import Match, Proposal, SlamConfig, SlamMethods, SurfaceGeometry
from tests.cli.test_slam import run
from tests.io.test_fuzz import spoil
from tests.io.test_lidar_readers import FORMATS
from tests.slam.test_odometry import compacted, motion, planes, seen_from

NUM_FUZZED = int(os.environ.get("DPMJAX_NUM_FUZZED_DRIVES", "40"))
NUM_SCANS = 5


@dataclass(frozen=True)
class NoMatcher:
    fingerprint: str = "none"

    def encode(self, scan):
        return compacted(scan)

    def vector(self, scan):
        return np.ones(4, np.float32)

    def propose(self, source, target, num_motions):
        return Proposal(np.eye(4)[None], 0.0)

    def register(self, pairs):
        return [Match(np.eye(4), 0.0, 1.0) for _ in pairs]

    def overlaps(self, source, targets):
        return np.zeros(len(targets))


def leave_networks_out(patch: pytest.MonkeyPatch) -> None:
    methods = SlamMethods(NoMatcher(), SurfaceGeometry(model_preset("tiny")), SlamConfig())
    patch.setattr(slam, "slam_methods", lambda config: methods)
    patch.setattr(slam_run, "draw_pictures", lambda *_: None)


def write_scan(path: Path, points: np.ndarray) -> None:
    FORMATS[path.suffix](path, points.astype(np.float32))


def write_drive(folder: Path, rng: np.random.Generator) -> None:
    suffix = str(rng.choice(list(FORMATS)))
    scans = folder / "velodyne" if rng.random() < 0.5 else folder
    scans.mkdir(parents=True)
    world, truth = planes(rng, num=300), np.array([motion(0.4 * step, 0, 0) for step in range(NUM_SCANS)])
    for number, T in enumerate(truth):
        write_scan(scans / f"{number:06}{suffix}", seen_from(world, T))
    if rng.random() < 0.7:
        write = write_tum if rng.random() < 0.5 else write_kitti
        write(folder / "poses_lidar.txt", truth)
    if rng.random() < 0.7:
        (folder / "times.txt").write_text("".join(f"{0.1 * number:.6f}\n" for number in range(NUM_SCANS)))


def bad_numbers(path: Path, rng: np.random.Generator) -> None:
    values = np.array([np.nan, np.inf, -np.inf, 1e38, 0.0, 1e-40, 1e6], np.float32)
    points = rng.normal(size=(200, 3)).astype(np.float32) * 10
    share = rng.choice([0.01, 0.5, 1.0])
    spoilt = rng.random(points.shape) < share
    points[spoilt] = rng.choice(values, int(spoilt.sum()))
    if path.suffix in FORMATS:
        write_scan(path, points)
    else:
        np.savetxt(path, points)


def few_points(path: Path, rng: np.random.Generator) -> None:
    points = rng.normal(size=(int(rng.integers(0, 4)), 3)) * rng.choice([0.0, 1.0, 20.0])
    if path.suffix in FORMATS:
        write_scan(path, points)
    else:
        path.write_text("")


DAMAGES = (bad_numbers, few_points, spoil, spoil, spoil)


def damage(folder: Path, rng: np.random.Generator) -> list[str]:
    done = []
    for _ in range(int(rng.integers(1, 4))):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        texts = [path for path in files if path.suffix == ".txt"]
        chosen = texts if texts and rng.random() < 0.4 else files
        if chosen:
            path, harm = chosen[rng.integers(len(chosen))], DAMAGES[rng.integers(len(DAMAGES))]
            harm(path, rng)
            done.append(f"{harm.__name__} {path.name}")
    return done


@pytest.mark.parametrize("seed", range(NUM_FUZZED))
def test_a_broken_drive_ends_with_results_or_one_line(seed, without_networks, tmp_path, capsys) -> None:
    rng = np.random.default_rng(seed)
    drive, out = tmp_path / "drive", tmp_path / "out"
    write_drive(drive, rng)
    done = damage(drive, rng)
    options = [*(["--deskew"] if rng.random() < 0.3 else []), *(["-j", 2] if rng.random() < 0.2 else [])]
    code = run(drive, "-o", out, *options)
    errors = capsys.readouterr().err
    told = [line for line in errors.replace("\r", "\n").splitlines() if line.startswith("dpmjax: error:")]
    assert "Traceback" not in errors, done
    assert code in (EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT)
    assert len(told) == (code != EXIT_OK), (done, errors)
    if code == EXIT_BAD_INPUT:
        assert not out.exists(), done
        assert str(drive) in told[0] or drive.name in told[0], (done, told)
    else:
        for name in ("trajectory.npy", "trajectory_tum.txt", "scans.csv", "graph.g2o", "metrics.json"):
            assert (out / name).is_file(), (done, name)
        assert np.isfinite(np.load(out / "trajectory.npy")).all()
    shutil.rmtree(tmp_path)

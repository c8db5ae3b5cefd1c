"""Several drives on a cluster: the same poses as one by one, also where a worker is killed."""

import os
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli.run import EXIT_OK, load_json
from dpmjax.io import write_tum
from tests.cli.test_slam import run
from tests.deeppointmap import toy
from tests.optional import import_or_skip
from tests.slam.test_odometry import motion, planes, seen_from

NUM_SCANS = 24


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    folder, rng = tmp_path_factory.mktemp("fleet"), np.random.default_rng(0)
    for name, turn_deg in (("first", 3.0), ("second", -3.0)):
        (folder / name).mkdir()
        truth = np.array([motion(0.25 * step, 0.0, turn_deg * step) for step in range(NUM_SCANS)])
        for number, T in enumerate(truth):
            np.save(folder / name / f"{number}.npy", seen_from(planes(rng), T).astype(np.float32))
        write_tum(folder / name / "poses_lidar.txt", truth)
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL), folder / "toy.safetensors", card="toy")
    return [folder / "first", folder / "second"], folder / "toy.safetensors"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("is_killed", [False, True])
def test_drives_of_a_cluster_are_those_of_one_process(drives, tmp_path, monkeypatch, is_killed: bool) -> None:
    distributed = import_or_skip("distributed")
    (first, second), weights = drives
    out, pids = tmp_path / "out", list[int]()
    submit = distributed.Client.submit

    def submit_and_kill(client, function, *arguments, **options):
        future = submit(client, function, *arguments, **options)
        if is_killed and not pids and function.__name__ == "map_away":
            time.sleep(10.0)  # the worker has begun
            pids.append(next(iter(client.run(os.getpid).values())))
            os.kill(pids[0], signal.SIGKILL)
        return future

    monkeypatch.setattr(distributed.Client, "submit", submit_and_kill)
    assert run(first, second, "--weights", weights, "--cluster", "local", "-o", out) == EXIT_OK
    assert len(pids) == is_killed
    numbers = load_json(out / "metrics.json")
    assert (numbers["num_drives"], numbers["num_scans"]) == (2, 2 * NUM_SCANS)
    assert numbers["num_maps"] == len(list(out.glob("map*.npz")))
    for number, drive in enumerate((first, second), start=1):
        assert run(drive, "--weights", weights, "-o", tmp_path / f"alone_{number}") == EXIT_OK
        alone = np.load(tmp_path / f"alone_{number}" / "trajectory.npy")
        np.testing.assert_allclose(np.load(out / f"drive_{number}" / "trajectory.npy"), alone, atol=1e-9)

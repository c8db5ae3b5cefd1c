"""The shipped weights: they load by name, are small, and register simulated scans that they have never seen."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap import Model, encode, register
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error, registration_recall
from dpmjax.simulation import SceneMixture, draw_scene, simulate_scene
from dpmjax.simulation.town.scan import OS1_64
from dpmjax.slam import run_slam
from dpmjax.weights import load_model, read_card, shipped_models
from dpmjax.weights.model_file import SHIPPED

MAX_BYTES = 20_000_000


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model("dpm_small")


def test_each_shipped_model_is_small_finite_calibrated_and_described():
    for name in shipped_models():
        path, model = SHIPPED / f"{name}.safetensors", load_model(name)
        assert path.stat().st_size < MAX_BYTES
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model.params))
        assert model.config.calibration is not None
        assert model.config.overlap is not None
        assert "docs/weights.md" in read_card(path)


def test_an_unknown_name_lists_the_shipped_one():
    with pytest.raises(ValueError, match=r"name of a shipped model \(dpm_small\)"):
        load_model("dpm_huge")


@pytest.mark.slow
def test_scans_of_an_unseen_suburb_are_registered_by_the_network_alone(model):
    scene = draw_scene(6_000_000, SceneMixture(kinds=(("suburb", 1.0),), sensors=((OS1_64, 1.0),), length_m=60.0))
    drive = simulate_scene(scene)
    pairs = [(0, 2), (3, 5), (8, 10), (12, 15), (16, 18)]
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    clouds = {row: drive.read_scan(row) for pair in pairs for row in pair}

    # Descriptors without points: nothing but the network can find the motion.
    found, true = [], []
    for a, b in pairs:
        source, target = encode(model, clouds[a] @ turn[:3, :3]), encode(model, clouds[b])
        found.append(np.asarray(register(model, source, target).T_target_source))
        true.append(rigid.inverse(drive.T_world_lidar[b]) @ drive.T_world_lidar[a] @ turn)
    assert registration_recall(np.stack(found), np.stack(true)).recall >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "degrees"), [("z", 180.0), ("x", 180.0), ("y", 30.0)], ids=["back", "down", "tilted"])
def test_a_lidar_may_be_mounted_in_any_way(model: Model, axis: str, degrees: float) -> None:
    mixture = SceneMixture(kinds=(("suburb", 1.0),), sensors=((OS1_64, 1.0),), length_m=60.0, moving_rate=0.0)
    drive, T_lidar_mounted = simulate_scene(draw_scene(6_000_000, mixture)), np.eye(4)
    T_lidar_mounted[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    scans = [drive.read_scan(row) @ T_lidar_mounted[:3, :3] for row in range(len(drive))]
    found, true = run_slam(model, scans), drive.T_world_lidar @ T_lidar_mounted
    assert {report.status for report in found.reports} <= {"first", "tracked", "network"}
    assert absolute_trajectory_error(found.T_world_scan[:, :3, 3], true[:, :3, 3]) < 0.1

"""`dpmjax depth`: errors of poses, and input that is refused."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from dpmjax.cli.depth import DepthOptions, read_images
from dpmjax.geometry import rigid
from dpmjax.metrics import depth_errors
from dpmjax.sequences import DepthSequence, InputError


@pytest.fixture
def walk() -> DepthSequence:
    """Five cameras on a line, turned a little, each in front of other points."""
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.2, (5, 3))).as_matrix()
    T[:, 0, 3] = 0.3 * np.arange(5)
    points = rng.uniform(1.0, 3.0, (5, 4, 6, 3)).astype(np.float32)
    return DepthSequence("walk", points, np.ones((5, 4, 6), bool), False, T)


def test_cameras_on_one_line_have_no_error_in_any_world(walk) -> None:
    T_other_world = np.eye(4)
    T_other_world[:3, :3] = Rotation.from_euler("xyz", [2.0, 0.3, -1.0]).as_matrix()
    T_other_world[:3, 3] = [5.0, -2.0, 1.0]
    found = depth_errors(walk, rigid.matmul(T_other_world, walk.T_world_camera))
    assert max(found.values()) < 1e-5


def test_a_turned_camera_is_the_largest_error_of_a_turn(walk) -> None:
    T = walk.T_world_camera.copy()
    T[2, :3, :3] = T[2, :3, :3] @ Rotation.from_euler("y", 7.0, degrees=True).as_matrix()
    found = depth_errors(walk, T)
    assert found["largest_turn_error_deg"] == pytest.approx(7.0, abs=1e-6)
    assert found["ate_m"] < 1e-9
    assert found["point_distance_m"] > 0.02


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

"""Laws of the depth camera, its apartments and the readers."""

import numpy as np
import pytest

from dpmjax import io, simulation
from dpmjax.io import InputError
from dpmjax.sequences import Camera
from dpmjax.simulation.apartments import cast_depth
from tests.io.depth_files import write_png, write_pose_folder, write_scene
from tests.tolerances import ROUNDING

CAMERA = Camera(8, 6, 6.0, 6.5, 3.5, 2.5)


def box_distance_by_marching(origin, ray, centre, half, yaw):
    """First depth along the ray inside the box, by small steps."""
    for depth in np.arange(0.0, 6.0, 0.002):
        x, y, z = origin + depth * ray - centre
        u, v = np.cos(yaw) * x - np.sin(yaw) * z, np.sin(yaw) * x + np.cos(yaw) * z
        if abs(u) <= half[0] and abs(y) <= half[1] and abs(v) <= half[2]:
            return depth
    return np.inf


def test_depth_is_what_marching_along_the_rays_finds():
    rng = np.random.default_rng(0)
    centres, halves = rng.uniform([-1, -1, 1.5], [1, 1, 4], (4, 3)), rng.uniform(0.2, 0.7, (4, 3))
    yaws = rng.uniform(-1, 1, 4)
    rays = CAMERA.rays(np.arange(8.0), np.arange(6.0))
    depth = np.asarray(cast_depth(np.eye(4), rays, centres, halves, yaws))
    for row, column in [(0, 0), (2, 3), (3, 4), (5, 7), (1, 6)]:
        boxes = zip(centres, halves, yaws, strict=True)
        expected = min(box_distance_by_marching(np.zeros(3), rays[row, column], *box) for box in boxes)
        assert depth[row, column] == pytest.approx(expected, abs=0.004)


def test_from_within_a_box_its_walls_are_seen_and_empty_boxes_are_not():
    rays = CAMERA.rays(np.arange(8.0), np.arange(6.0))
    boxes = (np.zeros((2, 3)), np.array([[2.0, 2.0, 3.0], [0.0, 0.0, 0.0]]), np.zeros(2))
    depth = np.asarray(cast_depth(np.eye(4), rays, *boxes))
    expected = np.min(np.array([2.0, 2.0, 3.0]) / np.maximum(np.abs(rays), 1e-12), axis=-1)
    np.testing.assert_allclose(depth, expected, **ROUNDING)


def test_walks_keep_to_the_grid_and_neighbours_differ_by_one_step():
    sequence = simulation.simulate_depth_sequence(3, 8, seed=5)
    T = sequence.T_world_camera
    assert sequence.is_planar
    assert sequence.mask.mean() > 0.8
    np.testing.assert_allclose(T[:, 1, 3], 0.0)
    grid = T[:, [0, 2], 3] / 0.3
    np.testing.assert_allclose(grid, np.round(grid), atol=1e-9)
    moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned = np.degrees(np.arccos(np.clip((np.einsum("nij,nij->n", T[:-1, :3, :3], T[1:, :3, :3]) - 1) / 2, -1, 1)))
    is_turn = turned > 15.0
    np.testing.assert_allclose(moved, np.where(is_turn, 0.0, 0.3), atol=1e-6)
    np.testing.assert_allclose(turned, np.where(is_turn, 30.0, 0.0), atol=1e-5)


def test_all_images_of_a_walk_see_the_same_walls():
    sequence = simulation.simulate_depth_sequence(1, 8, seed=0)
    T = sequence.T_world_camera
    world = np.einsum("nij,nhwj->nhwi", T[:, :3, :3], sequence.points) + T[:, None, None, :3, 3]
    home = simulation.make_apartment(1)
    inside = world[sequence.mask]
    assert (inside[:, [0, 2]] > -1e-3).all()
    assert (inside[:, 0] < home.size_x_m + 1e-3).all()
    np.testing.assert_allclose([inside[:, 1].min(), inside[:, 1].max()], [-1.5, 1.1], atol=1e-3)


def test_hard_walks_move_and_turn_at_once_and_are_wide():
    sequence = simulation.simulate_depth_sequence(3, 16, seed=5, config=simulation.HARD_WALK)
    T = sequence.T_world_camera
    moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned = np.arccos(np.clip((np.einsum("nij,nij->n", T[:-1, :3, :3], T[1:, :3, :3]) - 1) / 2, -1, 1))
    assert ((moved > 0.15) & (turned > np.radians(15))).sum() > 5
    assert (moved < 0.7).all()
    spread = np.sqrt(np.mean(np.sum((T[:, :3, 3] - T[:, :3, 3].mean(axis=0)) ** 2, axis=1)))
    assert spread >= 0.45
    assert simulation.make_apartment(3).is_free(T[:, [0, 2], 3], 0.09).all()


def test_noise_and_missing_pixels_grow_with_the_square_of_the_depth():
    clean = simulation.simulate_depth_sequence(3, 16, seed=5)
    config = simulation.DepthWalkConfig(depth_noise_m=0.01, dropout_share=0.1)
    noisy = simulation.simulate_depth_sequence(3, 16, seed=5, config=config)
    depth = clean.points[..., 2]
    noise = (noisy.points[..., 2] - depth)[noisy.mask] / depth[noisy.mask] ** 2
    assert noise.std() == pytest.approx(0.01, rel=0.05)
    for low, high in ((1.0, 2.0), (2.0, 3.0), (3.0, 4.0)):
        among = clean.mask & (depth > low) & (depth < high)
        expected = 0.1 * np.mean((depth[among] / 3.0) ** 2)
        assert (~noisy.mask[among]).mean() == pytest.approx(expected, rel=0.2)


def test_pose_folders_are_read_in_natural_order(tmp_path):
    sequence = io.read_pose_folder(write_pose_folder(tmp_path), height=6, width=8)
    np.testing.assert_array_equal(sequence.T_world_camera[:, 0, 3], [2, 10])
    assert not sequence.is_planar
    assert not sequence.mask[:, 0, :2].any()
    assert sequence.mask[:, 1:].all()
    x, y, z = sequence.points[0, 5, 7]
    np.testing.assert_allclose([x, y, z], [3.5 / 6.0, 2.5 / 6.5, 1.0], **ROUNDING)


INTRINSICS, POSE = "camera-intrinsics.txt", "frame-10.pose.txt"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (POSE, None, f"no {POSE}"),
        (INTRINSICS, None, "intrinsics"),
        ("frame-2.depth.png", "no picture", "not a readable PNG"),
        ("frame-2.depth.png", None, "at least two"),
        (POSE, "1 2 3", "a matrix of"),
        (INTRINSICS, "6 0 3.5\n0 -6.5 2.5\n0 0 1", "focal lengths above 0"),
        (INTRINSICS, "6 0 0\n0 6 0\n3 2 1", "axis at column 0, row 0, beside"),
        (INTRINSICS, "12 0 7\n0 13 5\n0 0 1", "beside the images of 8 x 6"),
        (POSE, "0 0 0 0\n" * 4, f"{POSE}: pose 0 is no rigid"),
        (POSE, "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "no rigid motion"),
    ],
)
def test_damaged_pose_folders_are_told_in_one_line(tmp_path, name, content, message):
    path = write_pose_folder(tmp_path) / name
    path.unlink() if content is None else path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        io.read_pose_folder(tmp_path, height=6, width=8)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scale", [0, 3, 10])
def test_depth_of_another_unit_is_refused_where_an_image_is_empty(tmp_path, scale):
    """Images of 1 and 5 m."""
    write_pose_folder(tmp_path)
    for index in (2, 10):
        write_png(tmp_path / f"frame-{index}.depth.png", np.full((6, 8), 500 * index * scale))
    with pytest.raises(InputError, match=f"median depth is {3 * scale} m, .* give millimetres"):
        io.read_pose_folder(tmp_path, height=6, width=8)


def test_active_vision_scenes_are_walked_along_their_links(tmp_path):
    scene = write_scene(tmp_path)
    sequence = io.read_active_vision(scene, 8, seed=3, height=6, width=8)
    assert sequence.is_planar
    assert len(sequence) == 8
    T = sequence.T_world_camera
    assert set(np.round(T[:, 0, 3], 6)) == {0.0, 0.3}  # 0.1 units of 3000 mm
    view = np.round((sequence.points[:, 3, 3, 2] - 2.0) * 1000).astype(int)
    np.testing.assert_allclose(T[:, 0, 2], np.where(view % 2, np.sin(0.5), 0.0), atol=1e-9)
    np.testing.assert_allclose(T[:, 0, 3], 0.3 * (view // 2), atol=1e-9)
    changed = np.abs(np.diff(view))
    assert set(changed) <= {1, 2}
    again = io.read_active_vision(scene, 8, seed=3, height=6, width=8)
    np.testing.assert_array_equal(again.points, sequence.points)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("annotations.json", "{", "annotations"),
        ("image_structs.mat", "text", "MATLAB"),
        ("cameras.txt", "1 OPENCV 8 six 6 6 3 3\n", "not a camera"),
        ("cameras.txt", "# nothing\n", "no camera"),
    ],
)
def test_damaged_scenes_are_told_in_one_line(tmp_path, name, content, message):
    scene = write_scene(tmp_path)
    (scene / name).write_text(content)
    with pytest.raises(InputError, match=message):
        io.read_active_vision(scene, 8, height=6, width=8)

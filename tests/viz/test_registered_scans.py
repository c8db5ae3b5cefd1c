"""The picture of a registration shows what it was given, in one frame, whatever the scans are like."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dpmjax.types import ScanSet
from dpmjax.viz import Panel, registered_scans_figure, save_figure
from dpmjax.viz.registered_scans import MAX_POINTS_PER_PANEL, time_colormap


def pixels(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


def scans_of_a_room(num_scans=6, num_beams=40):
    rng = np.random.default_rng(3)
    poses = np.stack(
        [np.linspace(10, 60, num_scans), 20 + np.sin(np.arange(num_scans)), np.arange(num_scans) / 5.0], axis=1
    )
    walls = np.concatenate(
        [np.stack([rng.uniform(0, 80, (num_scans, num_beams)), np.full((num_scans, num_beams), 50.0)], -1)]
    )
    offset = walls - poses[:, None, :2]
    cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    points = np.stack([cos * offset[..., 0] + sin * offset[..., 1], -sin * offset[..., 0] + cos * offset[..., 1]], -1)
    return points, np.ones(points.shape[:2], bool), poses, walls


def moved(poses, angle=0.7, shift=(300.0, -40.0)):
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.concatenate([poses[:, :2] @ rotation.T + shift, poses[:, 2:] + angle], axis=1)


def map_axes(figure):
    return [axes for axes in figure.axes if axes.collections]


def test_panel_puts_points_where_the_poses_say():
    points, mask, poses, walls = scans_of_a_room()
    np.testing.assert_allclose(Panel("result", ScanSet(points, mask), poses).points_world, walls, atol=1e-9)


def test_panels_share_limits_and_lie_on_the_reference():
    points, mask, poses, walls = scans_of_a_room()
    figure = registered_scans_figure(
        [
            Panel("result", ScanSet(points, mask), moved(poses)),
            Panel("reference", ScanSet(points, mask), poses, is_reference=True),
        ],
        "px",
    )
    result, reference = map_axes(figure)
    assert result.get_xlim() == reference.get_xlim()
    assert result.get_ylim() == reference.get_ylim()
    drawn = [np.sort(axes.collections[0].get_offsets(), axis=0) for axes in (result, reference)]
    np.testing.assert_allclose(drawn[0], drawn[1], atol=1e-6)
    np.testing.assert_allclose(drawn[1], np.sort(walls.reshape(-1, 2), axis=0), atol=1e-9)


def test_trajectory_is_black_and_scans_have_the_colours_of_time():
    points, mask, poses, _ = scans_of_a_room(num_beams=200)
    image = pixels(registered_scans_figure([Panel("result", ScanSet(points, mask), poses)], "m"))
    assert (image.sum(axis=-1) == 0).sum() > 100
    for fraction in (0.0, 1.0):
        color = np.round(255 * np.array(time_colormap()(fraction)[:3])).astype(int)
        assert (np.abs(image - color).max(axis=-1) <= 2).sum() > 20


def test_title_carries_the_numbers_with_their_unit():
    points, mask, poses, _ = scans_of_a_room()
    figure = registered_scans_figure(
        [Panel("warm start", ScanSet(points, mask), poses, ate=16.13, point_distance=0.0004)], "px"
    )
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert "warm start" in texts
    assert "ATE 16.1 px   point distance < 0.001 px" in texts


def test_masked_and_diverged_points_are_not_drawn():
    points, mask, poses, _ = scans_of_a_room()
    mask[:, ::2] = False
    points[:, ::2] = 1e9
    poses[-1] = np.nan
    (axes,) = map_axes(registered_scans_figure([Panel("result", ScanSet(points, mask), poses)], "px"))
    offsets = axes.collections[0].get_offsets()
    assert len(offsets) == (len(poses) - 1) * mask.shape[1] // 2
    assert np.abs(offsets).max() < 1e3


def test_a_panel_that_flew_apart_does_not_shrink_the_others():
    points, mask, poses, _ = scans_of_a_room()
    wild = poses * [1000.0, 1000.0, 1.0]
    figure = registered_scans_figure(
        [
            Panel("start", ScanSet(points, mask), wild),
            Panel("reference", ScanSet(points, mask), poses, is_reference=True),
        ],
        "px",
    )
    assert np.ptp(map_axes(figure)[0].get_xlim()) < 4 * 80


@pytest.mark.parametrize("is_standing", [True, False])
def test_degenerate_scans_still_give_a_picture(is_standing, tmp_path):
    points, mask, poses, _ = scans_of_a_room(num_scans=1 if is_standing else 4)
    if is_standing:
        mask[:] = False
    else:
        points[:] = 0.0
        poses[:] = 0.0
    save_figure(
        registered_scans_figure([Panel("result", ScanSet(points, mask), poses)], "m"), tmp_path / "map.png", dpi=60
    )
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["map.png"]


def test_many_points_are_thinned_to_the_budget():
    points = np.random.default_rng(0).uniform(0, 50, (4, MAX_POINTS_PER_PANEL // 2, 2))
    poses = np.zeros((4, 3))
    (axes,) = map_axes(
        registered_scans_figure([Panel("result", ScanSet(points, np.ones(points.shape[:2], bool)), poses)], "m")
    )
    assert len(axes.collections[0].get_offsets()) == MAX_POINTS_PER_PANEL


def test_panels_of_other_scans_are_refused():
    points, mask, poses, _ = scans_of_a_room()
    panels = [Panel("a", ScanSet(points, mask), poses), Panel("b", ScanSet(points[:2], mask[:2]), poses[:2])]
    with pytest.raises(ValueError, match=r"\[6, 2\]"):
        registered_scans_figure(panels, "px")
    with pytest.raises(ValueError, match="poses"):
        Panel("a", ScanSet(points, mask), poses[:, :2])


@pytest.mark.slow
def test_drawing_leaves_no_global_state_and_no_early_matplotlib():
    code = (
        "import sys, numpy as np, dpmjax.viz as viz; assert not {'jax', 'matplotlib'} & set(sys.modules);"
        "from dpmjax.types import ScanSet;"
        "panel = viz.Panel('a', ScanSet(np.ones((2, 3, 2)), np.ones((2, 3))), np.zeros((2, 3)));"
        "viz.registered_scans_figure([panel], 'm');"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

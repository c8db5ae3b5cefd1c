"""Laws of the local map: the nearest keyframes that the graph joins to the last one, and the last scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.geometry import rigid
from dpmjax.scans.surfaces import surface_of_elements
from dpmjax.slam import KeyframeMap, OdometryConfig
from dpmjax.slam.keyframes import Keyframe, MapEdge, add_keyframe
from dpmjax.slam.local_map import (
    RECENT_SHARE,
    PlacedElements,
    joined_surface,
    local_map_of,
    nearest_keyframe,
    placed_scan,
    with_scan,
)
from dpmjax.types import SurfaceElements
from tests.slam.truth import compact_of, laps, number_of, pose

CONFIG = OdometryConfig(num_keyframes=5, num_recent=3)
TRUTH = laps(1, side_m=20.0, step_m=2.0)
EXTENT_M = 10.0
SPACING_M = RECENT_SHARE * EXTENT_M


def chain(T_world_keyframe: np.ndarray, missing_edge: int | None = None) -> KeyframeMap:
    """A chain of keyframes; the edge from one of them to that before may be missing."""
    slam_map = KeyframeMap()
    for row, T in enumerate(T_world_keyframe):
        edge = MapEdge(row, row - 1, np.eye(4), np.eye(6), "odometry") if row not in (0, missing_edge) else None
        slam_map = add_keyframe(slam_map, Keyframe(row, T, 2.0 * row, 0, 10.0, compact_of(row)), T, np.ones(1), edge)
    return slam_map


def elements_at(x: float, planarity: float = 1.0) -> SurfaceElements:
    """Two elements, of which the second is not there."""
    return SurfaceElements(
        np.float32([[x, 0, 0], [7, 7, 7]]),
        np.float32([[0, 0, 1]] * 2),
        np.float32([planarity] * 2),
        np.array([True, False]),
    )


def numbers(slam_map: KeyframeMap, config: OdometryConfig = CONFIG) -> list[int]:
    return [number_of(scan) for scan in local_map_of(slam_map, (), config).compact]


def test_a_local_map_is_of_the_nearest_keyframes_in_the_frame_of_the_last() -> None:
    slam_map = chain(TRUTH)
    found = local_map_of(slam_map, (), CONFIG)
    last = len(TRUTH) - 1
    apart = np.linalg.norm(TRUTH[:, :3, 3] - TRUTH[last, :3, 3], axis=1)
    # The way round ends where it began: the first keyframes are near, but no edge is short enough.
    assert numbers(slam_map)[0] == last
    assert set(numbers(slam_map)) == set(range(last - 4, last + 1))
    loop = MapEdge(last, 0, np.eye(4), np.eye(6), "loop")
    closed = replace(slam_map, edges=(*slam_map.edges, loop))
    nearest = np.argsort(apart, kind="stable")[:5]
    np.testing.assert_allclose(sorted(apart[numbers(closed)]), apart[nearest])
    assert 0 in numbers(closed)
    for T, number in zip((placed.T_map_scan for placed in found.keyframes), numbers(slam_map), strict=True):
        np.testing.assert_allclose(T, rigid.inverse(TRUTH[last]) @ TRUTH[number], atol=1e-12)
    # Each keyframe has one element; its first coordinate in the frame of the scan is the number.
    expected = [rigid.inverse(TRUTH[last]) @ TRUTH[number] @ [number, 0, 0, 1] for number in numbers(slam_map)]
    np.testing.assert_allclose(found.surface.points, np.array(expected)[:, :3], atol=1e-5)
    np.testing.assert_allclose(found.surface.normals, [[0, 0, 1]] * 5, atol=1e-9)


def test_keyframes_that_no_edge_joins_stay_out() -> None:
    slam_map = chain(TRUTH, missing_edge=len(TRUTH) - 2)
    assert set(numbers(slam_map)) == {len(TRUTH) - 2, len(TRUTH) - 1}
    guess = MapEdge(len(TRUTH) - 2, len(TRUTH) - 3, np.eye(4), np.eye(6), "guess")
    assert numbers(replace(slam_map, edges=(*slam_map.edges, guess))) == numbers(slam_map)


def test_a_local_map_moves_with_the_frame_of_the_map() -> None:
    first, second = (local_map_of(chain(T @ TRUTH), (), CONFIG) for T in (np.eye(4), pose(30.0, -8.0, 1.0)))
    np.testing.assert_allclose(first.surface.points, second.surface.points, atol=1e-5)


def test_a_scan_that_adds_nothing_does_not_join() -> None:
    recent = (PlacedElements(np.eye(4), elements_at(5.0)),)
    for T in (pose(0, 0, 0), pose(0.99 * SPACING_M, 0, 0), pose(0, 0, 0.16)):
        assert with_scan(recent, PlacedElements(T, elements_at(5.0)), EXTENT_M, CONFIG) is recent
    for T in (pose(1.01 * SPACING_M, 0, 0), pose(0, 0, 0.18)):
        placed = PlacedElements(T, elements_at(5.0))
        joined = with_scan(recent, placed, EXTENT_M, CONFIG)
        assert joined == (*recent, placed)
        # The distance is that from the last scan that has joined.
        assert with_scan(joined, placed, EXTENT_M, CONFIG) is joined
        assert len(with_scan(joined, recent[0], EXTENT_M, CONFIG)) == 3
    assert with_scan((), recent[0], EXTENT_M, CONFIG) == recent
    # People move around a lidar that stands still.
    here = PlacedElements(np.eye(4), elements_at(6.0))
    assert with_scan(recent, here, EXTENT_M, CONFIG, is_changed=True) == (*recent, here)


def test_the_oldest_of_too_many_scans_leaves() -> None:
    recent: tuple[PlacedElements, ...] = ()
    for step in range(1, 6):
        recent = with_scan(recent, PlacedElements(pose(step, 0, 0), elements_at(5.0 + step)), EXTENT_M, CONFIG)
    assert [placed.T_map_scan[0, 3] for placed in recent] == [3, 4, 5]
    surface = local_map_of(chain(TRUTH[:3]), recent, CONFIG).surface
    np.testing.assert_allclose(sorted(surface.points[-3:, 0]), [8 + 3, 9 + 4, 10 + 5], atol=1e-5)
    assert len(surface.points) == 3 + 3
    assert with_scan((), recent[0], EXTENT_M, replace(CONFIG, num_recent=0)) == ()


def test_a_placed_scan_has_the_flat_elements() -> None:
    rough = SurfaceElements(np.eye(3), np.eye(3), np.array([1.0, 0.05, 0.5]), np.ones(3, bool))
    placed = placed_scan(surface_of_elements(rough), pose(1, 0, 0))
    np.testing.assert_array_equal(placed.elements.positions, np.eye(3)[[0, 2]])
    np.testing.assert_array_equal(placed.elements.planarity, np.float32([1.0, 0.5]))
    assert placed.elements.positions.dtype == placed.elements.normals.dtype == np.float32


def test_elements_of_a_turned_scan_are_turned() -> None:
    wall = replace(elements_at(5.0), normals=np.float32([[1, 0, 0]] * 2))
    joined = joined_surface([PlacedElements(pose(1.0, 2.0, np.pi / 2), wall)])
    np.testing.assert_allclose(joined.points[-1], [1.0, 7.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(joined.normals[-1], [0.0, 1.0, 0.0], atol=1e-6)


def test_elements_without_a_plane_stay_out() -> None:
    recent = (PlacedElements(pose(3, 0, 0), elements_at(5.0, planarity=0.05)),)
    without, joined = (local_map_of(chain(TRUTH[:3]), some, CONFIG).surface for some in ((), recent))
    np.testing.assert_array_equal(joined.points, without.points)
    assert sorted(joined.samples) == list(range(3))


@pytest.mark.parametrize("row", range(5))
def test_the_nearest_keyframe_is_nearest(row: int) -> None:
    local_map = local_map_of(chain(TRUTH), (), CONFIG)
    position = local_map.keyframes[row].T_map_scan[:3, 3] + [0.3, -0.4, 0.2]
    assert nearest_keyframe(local_map, position) == row

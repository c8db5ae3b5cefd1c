"""Laws of the local map: the nearest keyframes that the graph joins to the last one, and the last scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.slam import KeyframeMap, OdometryConfig
from dpmjax.slam.keyframe_map import Keyframe, MapEdge, add_keyframe
from dpmjax.slam.local_map import (
    RECENT_SHARE,
    PlacedElements,
    joined_surface,
    local_map_of,
    with_scan,
)
from tests.slam.truth import compact_of, laps, number_of, pose

CONFIG = OdometryConfig(num_keyframes=5)
TRUTH = laps(1, side_m=20.0, step_m=2.0)
SPACING_M = 0.8
EXTENT_M = SPACING_M / RECENT_SHARE


def chain(T_world_keyframe: np.ndarray, missing_edge: int | None = None) -> KeyframeMap:
    """Returns a chain of keyframes; `missing_edge` leaves out the edge from this keyframe to the one before it."""
    slam_map = KeyframeMap()
    for row, T in enumerate(T_world_keyframe):
        edge = MapEdge(row, row - 1, np.eye(4), np.eye(6), "odometry") if row not in (0, missing_edge) else None
        slam_map = add_keyframe(slam_map, Keyframe(row, T, 2.0 * row, 0, 10.0, compact_of(row)), T, np.ones(1), edge)
    return slam_map


def placed_at(T: np.ndarray, x: float) -> PlacedElements:
    """A scan of one element, whose first coordinate is x."""
    return PlacedElements(T, np.float32([[x, 0, 0]]), np.float32([[0, 0, 1]]), np.float32([1]))


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
    recent = (placed_at(np.eye(4), 5.0),)
    for T in (pose(0, 0, 0), pose(0.99 * SPACING_M, 0, 0), pose(0, 0, 0.16)):
        assert with_scan(recent, placed_at(T, 5.0), EXTENT_M) is recent
    for T in (pose(1.01 * SPACING_M, 0, 0), pose(0, 0, 0.18)):
        placed = placed_at(T, 5.0)
        joined = with_scan(recent, placed, EXTENT_M)
        assert joined == (*recent, placed)
        # The distance is that from the last scan that has joined.
        assert with_scan(joined, placed, EXTENT_M) is joined
        assert len(with_scan(joined, recent[0], EXTENT_M)) == 3
    assert with_scan((), recent[0], EXTENT_M) == recent
    # People move around a lidar that stands still.
    here = placed_at(np.eye(4), 6.0)
    assert with_scan(recent, here, 0.0) == (*recent, here)


def test_the_oldest_of_too_many_scans_leaves() -> None:
    recent: tuple[PlacedElements, ...] = ()
    for step in range(1, 11):
        recent = with_scan(recent, placed_at(pose(step, 0, 0), 5.0 + step), EXTENT_M)
    assert [placed.T_map_scan[0, 3] for placed in recent] == list(range(3, 11))
    surface = local_map_of(chain(TRUTH[:3]), recent, CONFIG).surface
    np.testing.assert_allclose(sorted(surface.points[-8:, 0]), [5 + 2 * step for step in range(3, 11)], atol=1e-5)
    assert len(surface.points) == 3 + 8
    assert sorted(surface.samples) == list(range(11))


def test_elements_of_a_turned_scan_are_turned() -> None:
    wall = placed_at(pose(1.0, 2.0, np.pi / 2), 5.0)._replace(normals=np.float32([[1, 0, 0]]))
    joined = joined_surface([wall])
    np.testing.assert_allclose(joined.points, [[1.0, 7.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(joined.normals, [[0.0, 1.0, 0.0]], atol=1e-6)

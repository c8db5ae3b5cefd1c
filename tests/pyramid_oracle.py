"""The point pyramid by slow and obvious NumPy float64: what the networks are tested on."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from dpmjax.geometry.pyramid import Interpolation, PointPyramid, PyramidConfig, PyramidLevel

# Scans are quantised, so points at exactly the radius are common, and rounding must not decide about them.
RADIUS_SLACK = 1 + 1e-6


def farthest_points(points: np.ndarray, num_points: int) -> np.ndarray:
    """Each the farthest from all before it, from index 0; where the points are used up, index 0 again."""
    chosen = [0]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(num_points, len(points)):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen + [0] * (num_points - len(chosen)))


def nearest(queries: np.ndarray, points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and distances, nearest first; where there are fewer than k points, the nearest again."""
    distances = np.sqrt(((queries[:, None] - points[None]) ** 2).sum(axis=-1))
    indices = np.argsort(distances, axis=1, kind="stable")[:, :k]
    indices = np.concatenate([indices, np.repeat(indices[:, :1], k - indices.shape[1], axis=1)], axis=1)
    return indices, np.take_along_axis(distances, indices, axis=1)


def neighbourhood(queries: np.ndarray, points: np.ndarray, k: int, radius: float) -> np.ndarray:
    indices, distances = nearest(queries, points, k)
    return np.where(distances <= radius * RADIUS_SLACK, indices, indices[:, :1])


def padded(rows: np.ndarray, capacity: int) -> np.ndarray:
    return np.concatenate([rows, np.zeros((capacity - len(rows), *rows.shape[1:]), rows.dtype)])


def build_pyramid_oracle(points: np.ndarray, config: PyramidConfig, capacity: int | None = None) -> PointPyramid:
    """The pyramid of valid normalised points (n, 3) at the front of `capacity` rows, the rest of them NaN."""
    points = points.astype(np.float64)
    capacity = len(points) if capacity is None else capacity
    valid = [points]
    empty = np.zeros(0, np.int32)
    front = np.full((capacity, 3), np.nan, np.float32)
    front[: len(points)] = points
    levels = [PyramidLevel(*map(jnp.asarray, (front, np.arange(capacity) < len(points), empty)), ())]
    for stage in config.stages:
        before, m = valid[-1], min(stage.num_points, len(valid[-1]))
        sample = farthest_points(before, stage.num_points)[:m]
        here = before[sample]
        searched = [before] + [here] * (len(stage.radii) - 1)
        blocks = [
            neighbourhood(here, cloud, stage.num_neighbours, radius)
            for cloud, radius in zip(searched, stage.radii, strict=True)
        ]
        levels.append(
            PyramidLevel(
                positions=jnp.asarray(padded(here.astype(np.float32), stage.num_points)),
                mask=jnp.arange(stage.num_points) < m,
                sample_indices=jnp.asarray(padded(sample.astype(np.int32), stage.num_points)),
                neighbours=tuple(jnp.asarray(padded(block.astype(np.int32), stage.num_points)) for block in blocks),
            )
        )
        valid.append(here)
    return PointPyramid(tuple(levels), tuple(interpolations(valid, levels, config.num_interpolations)))


def interpolations(valid: list[np.ndarray], levels: list[PyramidLevel], num_steps: int) -> list[Interpolation]:
    steps = []
    for step in range(num_steps):
        fine, coarse = valid[-2 - step], valid[-1 - step]
        indices, distances = nearest(fine, coarse, 3)
        weights = 1 / (distances**2 + 1e-8)
        weights /= weights.sum(axis=1, keepdims=True)
        num_rows = len(levels[-2 - step].mask)
        arrays = (indices.astype(np.int32), weights.astype(np.float32))
        steps.append(Interpolation(*(jnp.asarray(padded(array, num_rows)) for array in arrays)))
    return steps

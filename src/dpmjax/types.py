"""The records of the project: frozen pytrees of arrays and masks.

Ragged things are capacity + mask: an array of fixed size and a boolean of the same leading shape, True for
valid entries. Masked entries may hold anything, NaN too, and never take part in a result.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import flax.struct
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Record = TypeVar("Record")
# Longest text of a value on the line of its record.
_MAX_TEXT = 40


def with_short_repr(record: type[Record]) -> type[Record]:
    """Prints a class of records on one line: shapes of arrays, lengths of sequences, and short values.

    Args:
        record: a NamedTuple or a dataclass.

    Returns:
        The class.
    """
    record.__repr__ = _short_repr  # type: ignore[method-assign]
    return record


def _short_repr(record: Any) -> str:
    names = getattr(record, "_fields", None) or [field.name for field in dataclasses.fields(record)]
    return f"{type(record).__name__}({', '.join(f'{name}={_short(getattr(record, name))}' for name in names)})"


def _short(value: Any) -> str:
    if getattr(value, "shape", ()):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, dict | list | tuple) and not hasattr(value, "_fields"):
        return f"{len(value)} items"
    is_number = isinstance(value, jax.Array | float) and not isinstance(value, jax.core.Tracer)
    text = f"{float(value):.4g}" if is_number else repr(value)
    return text if len(text) <= _MAX_TEXT else f"{type(value).__name__}(...)"


# Input of public functions: an array of JAX or of NumPy. They return arrays of JAX.
AnyArray = jax.Array | np.ndarray

# Poses and motions on the host: homogeneous matrices, one or several.
Pose = Float[np.ndarray, "4 4"]
Poses = Float[np.ndarray, "_n 4 4"]

# Inverse covariance of a motion on the host, in the tangent of its source, translation first.
Information = Float[np.ndarray, "6 6"]


@with_short_repr
@flax.struct.dataclass
class ScanSet:
    """A set of scans of equal capacity, each in its own sensor frame.

    Attributes:
        points: beam end points; metres or pixels, the same unit for all.
        mask: True where the beam measured something.
    """

    points: Float[Array, "n b d"]
    mask: Bool[Array, "n b"]


@with_short_repr
@flax.struct.dataclass
class PointCloud:
    """A scan as a cloud of fixed capacity, in the frame of the lidar that took it.

    Attributes:
        points: metres, x forward, y left, z up.
        mask: True where there is a point.
    """

    points: Float[AnyArray, "n 3"]
    mask: Bool[AnyArray, " n"]


# A raw scan: points in metres, in the frame of the lidar, or their file.
RawScan = PointCloud | Float[AnyArray, "_n 3"] | str | Path


class Neighbours(NamedTuple):
    """The nearest points of each query, nearest first.

    Attributes:
        indices: row in the searched points; 0 where `mask` is False.
        squared_distances: squared distances, in squared units of the points; infinite where `mask` is False.
        mask: True where a neighbour exists (fewer valid points than `k`, or none within the radius: False).
    """

    indices: Int[Array, "m k"]
    squared_distances: Float[Array, "m k"]
    mask: Bool[Array, "m k"]


@flax.struct.dataclass
class SurfaceElements:
    """Points of a surface with the planes through their neighbourhoods.

    Attributes:
        positions: metres.
        normals: unit vectors of either sign; undefined where `planarity` is 0.
        planarity: in [0, 1]: (l2 - l1) / l3 of the eigenvalues of the covariance of the neighbourhood, smallest first;
            0 where there is no plane.
        mask: True for valid elements; invalid ones may hold anything.
    """

    positions: Float[AnyArray, "n d"]
    normals: Float[AnyArray, "n d"]
    planarity: Float[AnyArray, " n"]
    mask: Bool[AnyArray, " n"]


@flax.struct.dataclass
class DescriptorCloud:
    """A scan, or a union of scans, as sparse points that carry learned features (DeepPointMap section 3.1).

    The points of a scan are in the order of farthest-point sampling. The first m have features; further ones are
    surface elements only, for alignment.

    Attributes:
        positions: metres, in the frame of the lidar or of the map.
        features: learned description of the surroundings of each of the first m points.
        mask: True for points that are there.
        directions: cosine and sine of the azimuth of the frame of each descriptor (`EncoderConfig.frame`), in the
            frame of the cloud; a map keeps those of its scans. None for a single scan with frames along its rays, whose
            positions give them.
        normals: unit normals of the surface at each point, in the frame of the cloud, of either sign; None in a
            cloud without surface elements.
        planarity: see `SurfaceElements`; None together with `normals`.
    """

    positions: Float[Array, "n 3"]
    features: Float[Array, "m c"]
    mask: Bool[Array, " n"]
    directions: Float[Array, "m 2"] | None = None
    normals: Float[Array, "n 3"] | None = None
    planarity: Float[Array, " n"] | None = None

    def __repr__(self) -> str:
        return f"DescriptorCloud(positions {np.shape(self.positions)}, features {np.shape(self.features)})"

    @property
    def described(self) -> DescriptorCloud:
        """The points with features, without further surface elements, for matching; also of stacked clouds."""
        num = self.features.shape[-2]
        return DescriptorCloud(self.positions[..., :num, :], self.features, self.mask[..., :num], self.directions)

    @property
    def elements(self) -> SurfaceElements:
        """All points as surface elements; raises a `ValueError` if the cloud has no normals."""
        if self.normals is None or self.planarity is None:
            raise ValueError("cloud: expected surface elements, got a cloud without normals and planarity")
        return SurfaceElements(self.positions, self.normals, self.planarity, self.mask)


class Verification(NamedTuple):
    """Agreement of two scans under a motion; shares are in [0, 1].

    Attributes:
        visible_share: share of the points of both scans inside the mutual field of view.
        matched_share: share of the source points that meet a plane of the target. Where the target holds less than half
            the points of the source (a map saved at int8), the share of the target points that meet a plane of the
            source.
        contradicted_share: share of the visible points that lie in the free space seen by the opposite scan.
        score: log odds that the motion is right, by walls and level ground that meet and by free space.
        gap: difference of `score` to that of the best hypothesis for another place, or to 0 if that is more.
        num_tried: number of hypotheses that were tried.
        num_slid: number of further motions along a weak axis; 0 where the walls constrain all directions.
        facing_gap: lead over the best other motion, or over 0, in elements that face the weak axis: those that meet,
            less a penalty of those that contradict. It is 0 where no axis is weak.
        distinct_gap: `facing_gap`, times its share of the count of this motion, times the share of the visible elements
            facing the axis that meet. Places with like niches have many elements in common, but fewer than all, or the
            next niche has as many.
        lookalike_gap: lead of `score` over the best motion to any other place, those where the scans look alike from
            above among them; infinite where none of these was tried.
    """

    visible_share: float
    matched_share: float
    contradicted_share: float
    score: float
    gap: float = 0.0
    num_tried: int = 1
    num_slid: int = 0
    facing_gap: float = 0.0
    distinct_gap: float = 0.0
    lookalike_gap: float = math.inf


@with_short_repr
@flax.struct.dataclass
class Registration:
    """The motion between two descriptor clouds, and its confidence; failure is data.

    Attributes:
        T_target_source: motion that maps points of the source to the target; the identity where no pair was left.
        confidence: number in [0, 1]. With a calibrated model, `register` makes it the probability that the motion is
            right within 2 m and 5 degrees. Without calibration it is `mean_score`, which is no probability.
        mean_score: mean score of the first inliers, in [0, 1]; 0 without any.
        rmse: root mean square error of the inliers after alignment, metres; infinite with fewer than three distinct
            pairs.
        support: consensus support of the motion: sum of 1 - error / tolerance over distinct pairs.
        num_inliers: number of pairs that determine the motion, both directions counted.
        source_indices: row of each pair in the source; first the pairs of eq. 1, then the same of eq. 2.
        target_indices: the same in the target.
        scores: matching score of each pair, in [0, 1].
        is_inlier: True for pairs that determine the motion.
        verification: agreement of the scans themselves; None where only descriptors were registered.
        weak_direction: the horizontal direction in which the translation is least certain, as a unit vector in the
            target frame; in a corridor its axis. None where only descriptors were registered.
        weak_sigma_m: standard deviation of the translation along it, metres, by the planes that meet and how far parts
            of the scans disagree. It does not cover other places that look alike. None in the same case.
        relative_size: size of the source over that of the target by their surfaces, if it is not 1: one of the two
            has other units or a wrong calibration. None in the same case.
    """

    T_target_source: Float[Array, "4 4"]
    confidence: Float[Array, ""]
    mean_score: Float[Array, ""]
    rmse: Float[Array, ""]
    support: Float[Array, ""]
    num_inliers: Int[Array, ""]
    source_indices: Int[Array, " p"]
    target_indices: Int[Array, " p"]
    scores: Float[Array, " p"]
    is_inlier: Bool[Array, " p"]
    verification: Verification | None = None
    weak_direction: Float[Array, "3"] | None = None
    weak_sigma_m: Float[Array, ""] | None = None
    relative_size: Float[Array, ""] | None = None


@flax.struct.dataclass
class PyramidLevel:
    """One level; level 0 is the input, with `sample_indices` and `neighbours` empty.

    Attributes:
        positions: normalised coordinates; 0 for points that are not there.
        mask: True for points that are there.
        sample_indices: row of each point in the level before.
        neighbours: for each block (m, k) rows, nearest first, those beyond the radius replaced by the nearest. Block 0
            has neighbours in the level before, every later block in this level. Points that are not there are no
            neighbours.
    """

    positions: Float[AnyArray, "m 3"]
    mask: Bool[AnyArray, " m"]
    sample_indices: Int[AnyArray, " s"]
    neighbours: tuple[Int[AnyArray, "m k"], ...]


@flax.struct.dataclass
class Interpolation:
    """Interpolation of features from a coarser level to the next finer one.

    Attributes:
        indices: the three nearest points of the coarser level.
        weights: their weights; each row sums to one, or to zero where either side is masked.
    """

    indices: Int[AnyArray, "m 3"]
    weights: Float[AnyArray, "m 3"]


@flax.struct.dataclass
class PointPyramid:
    """All levels, fine to coarse, and the interpolations back to finer levels.

    Attributes:
        levels: the input and one level for each stage.
        interpolation: interpolation from the coarsest level upwards.
    """

    levels: tuple[PyramidLevel, ...]
    interpolation: tuple[Interpolation, ...]

"""The nouns of the project: frozen pytrees of arrays and masks.

Ragged things are capacity + mask: an array of fixed size and a boolean of the same leading shape that says which
entries are real. What is masked out may hold any finite number and never takes part in a result.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

AnyArray = jax.Array | np.ndarray
"""What public functions take: an array of JAX or of NumPy. They return arrays of JAX."""


@flax.struct.dataclass
class ScanSet:
    """A set of scans of equal capacity, each in its own sensor frame.

    Attributes:
        points: beam end points; metres or pixels, the same unit for all.
        mask: True where the beam measured something.
    """

    points: Float[Array, "n b d"]
    mask: Bool[Array, "n b"]


class Neighbours(NamedTuple):
    """The nearest points of each query, nearest first.

    Attributes:
        indices: row in the searched points; 0 where `mask` is False.
        squared_distances: in the unit of the points, squared; infinite where `mask` is False.
        mask: True where a neighbour exists (fewer valid points than `k`, or none within the radius: False).
    """

    indices: Int[Array, "m k"]
    squared_distances: Float[Array, "m k"]
    mask: Bool[Array, "m k"]


@flax.struct.dataclass
class PointCloud:
    """A scan as a cloud of fixed capacity, in the frame of its lidar.

    Attributes:
        points: metres.
        mask: True for points that are there.
    """

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


@flax.struct.dataclass
class DescriptorCloud:
    """A scan, or a union of scans, as sparse points that carry learned features (DeepPointMap section 3.1).

    Attributes:
        positions: metres, in the frame of the lidar or of the map.
        features: what the network says of the surroundings of each.
        mask: True for descriptors that are there.
    """

    positions: Float[Array, "m 3"]
    features: Float[Array, "m c"]
    mask: Bool[Array, " m"]

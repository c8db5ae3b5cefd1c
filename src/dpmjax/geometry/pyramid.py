"""The point pyramid: which points are kept from level to level, and which are whose neighbours.

Farthest-point order and neighbourhoods depend on coordinates only, so they are built once and apart from the network,
which is a function of its parameters and of this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import flax.struct
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import require_count, require_positive


@dataclass(frozen=True)
class PyramidStage:
    """One step down the pyramid.

    Attributes:
        num_points: how many points are kept, by farthest-point sampling.
        radii: of the neighbourhoods, normalised: the first looks into the level before, the others into this one.
        num_neighbours: how many neighbours each of them holds.
    """

    num_points: int
    radii: tuple[float, ...]
    num_neighbours: int

    def __post_init__(self) -> None:
        require_count("num_points", self.num_points)
        require_count("num_neighbours", self.num_neighbours)
        require_count("len(radii)", len(self.radii))
        for radius in self.radii:
            require_positive("radii", radius)


@dataclass(frozen=True)
class PyramidConfig:
    """The stages from fine to coarse (defaults: DeepPointMap's published configuration, radii in units of 60 m).

    Attributes:
        stages: the steps down.
        num_interpolations: how many steps up again, from the coarsest level.
    """

    stages: tuple[PyramidStage, ...] = (
        PyramidStage(4096, (0.05, 0.1), 32),
        PyramidStage(1024, (0.1, 0.2), 32),
        PyramidStage(256, (0.2, 0.4, 0.4), 32),
        PyramidStage(64, (0.4, 0.8), 32),
        PyramidStage(16, (0.8, 1.6), 16),
    )
    num_interpolations: int = 2

    def __post_init__(self) -> None:
        if not 0 <= self.num_interpolations < len(self.stages):
            expected = f"expected from 0 to {len(self.stages) - 1}, fewer than there are stages"
            raise ValueError(f"num_interpolations: {expected}, got {self.num_interpolations}")


@flax.struct.dataclass
class PyramidLevel:
    """One level; level 0 is the input, with `sample_indices` and `neighbours` empty.

    Attributes:
        positions: normalised coordinates.
        mask: True for points that are there.
        sample_indices: row of each point in the level before; of level 0 there is none.
        neighbours: for each block (m, k) rows, nearest first, those beyond the radius replaced by the nearest. Block 0
            looks into the level before, the others into this one. Points that are not there are nobody's neighbours.
    """

    positions: Float[Array, "*batch m 3"]
    mask: Bool[Array, "*batch m"]
    sample_indices: Int[Array, "*batch s"]
    neighbours: tuple[Int[Array, "*batch m k"], ...]


class Interpolation(NamedTuple):
    """How features of a coarser level are carried to the next finer one.

    Attributes:
        indices: the three nearest points of the coarser level.
        weights: their shares; each row sums to one.
    """

    indices: Int[Array, "*batch m 3"]
    weights: Float[Array, "*batch m 3"]


@flax.struct.dataclass
class PointPyramid:
    """All levels, fine to coarse, and the way up again.

    Attributes:
        levels: the input and one level for each stage.
        interpolation: from the coarsest level upwards.
    """

    levels: tuple[PyramidLevel, ...]
    interpolation: tuple[Interpolation, ...]

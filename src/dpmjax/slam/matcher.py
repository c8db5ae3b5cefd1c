"""What SLAM asks of a matcher, and the one that asks DeepPointMap's networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from dpmjax.deeppointmap.batches import overlap_pairs
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.matching import merge_clouds
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.scan_registration import PreparedScan, register_each
from dpmjax.deeppointmap.verification import MeasuredScan
from dpmjax.scans.free_space import RangeImage
from dpmjax.scans.surfaces import Surface
from dpmjax.slam.columns import Arrays
from dpmjax.slam.keyframes import Pose, Submap
from dpmjax.slam.retrieval import pooled_vector
from dpmjax.types import DescriptorCloud, Verification


class Match(NamedTuple):
    """A registration without a first guess.

    Attributes:
        T_target_source: float64.
        probability: that it is right within 2 m and 5 degrees, if the matcher is calibrated; else a score in [0, 1].
        rmse_m: of the pairs that it rests on.
        verification: how well the scans agree under it; None where the matcher has no scans.
    """

    T_target_source: Pose
    probability: float
    rmse_m: float
    verification: Verification | None = None


class Matcher(Protocol):
    """Recognises places and registers scans and maps without a first guess."""

    def describe(self, points: Float[np.ndarray, "n 3"], measured: Any) -> Any:
        """Prepares a scan for any number of registrations.

        Args:
            points: metres, in the frame of the lidar.
            measured: what the geometry has measured of it.

        Returns:
            A record that only the matcher reads.
        """
        ...

    def pack(self, description: Any) -> Arrays:
        """Turns a description into arrays for a file.

        Args:
            description: from `describe`.

        Returns:
            Arrays by name.
        """
        ...

    def unpack(self, arrays: Arrays) -> Any:
        """Makes a description again, bit for bit.

        Args:
            arrays: from `pack`.

        Returns:
            The description.
        """
        ...

    def vector(self, description: Any) -> Float[np.ndarray, " c"]:
        """Returns one vector for retrieval, of a length that is the same for all scans.

        Args:
            description: from `describe`.

        Returns:
            The vector.
        """
        ...

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        """Registers pairs of source and target.

        Args:
            pairs: submaps; a single scan is a submap of one.

        Returns:
            One match a pair, between the frames of the two submaps.
        """
        ...

    def overlaps(self, source: Any, targets: Sequence[Any]) -> Float[np.ndarray, " n"]:
        """Estimates the probability that scans see the same place, for many scans at once.

        Args:
            source: description of a scan.
            targets: of the others; at least one.

        Returns:
            The probabilities.
        """
        ...


class NetworkMatcher:
    """The matcher of a trained model.

    Args:
        model: encoder, decoder and, at best, a calibration of its confidence.
    """

    def __init__(self, model: Model) -> None:
        self._model = model

    def describe(self, points: Float[np.ndarray, "n 3"], measured: MeasuredScan) -> PreparedScan:
        """Encodes a scan; see `Matcher`.

        Args:
            points: metres, in the frame of the lidar.
            measured: surface and free space of the scan.

        Returns:
            The prepared scan.
        """
        return PreparedScan(jax.device_get(encode(self._model, points)), measured)

    def pack(self, description: PreparedScan) -> Arrays:
        """Keeps descriptors and surface; see `Matcher`.

        Args:
            description: from `describe`.

        Returns:
            Arrays by name.
        """
        cloud, surface, image = description.descriptors, description.measured.surface, description.measured.image
        arrays = {"positions": cloud.positions, "features": cloud.features, "mask": cloud.mask}
        arrays |= {} if cloud.directions is None else {"directions": cloud.directions}
        arrays |= surface._replace(tree=np.zeros(0))._asdict() | image._asdict()
        return {name: np.asarray(value) for name, value in arrays.items()}

    def unpack(self, arrays: Arrays) -> PreparedScan:
        """Makes the tree again; see `Matcher`.

        Args:
            arrays: from `pack`.

        Returns:
            The prepared scan.
        """
        tree = cKDTree(arrays["points"], leafsize=16, balanced_tree=False, compact_nodes=False)
        surface = Surface(*(arrays[name] for name in Surface._fields[:-1]), tree)
        image = RangeImage(arrays["nearest_m"], arrays["farthest_m"])
        cloud = DescriptorCloud(arrays["positions"], arrays["features"], arrays["mask"], arrays.get("directions"))
        return PreparedScan(cloud, MeasuredScan(surface, image))

    def vector(self, description: PreparedScan) -> Float[np.ndarray, " c"]:
        """Pools the descriptors; see `Matcher`.

        Args:
            description: from `describe`.

        Returns:
            The vector.
        """
        return pooled_vector(description.descriptors)

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        """Registers merged descriptors and verifies by the central scans; see `Matcher`.

        Args:
            pairs: submaps.

        Returns:
            One match a pair.
        """
        prepared = [(_merged(source), _merged(target)) for source, target in pairs]
        found = register_each(self._model, prepared, refine=True)
        return [
            Match(
                np.asarray(match.T_target_source, np.float64),
                float(match.confidence),
                float(match.rmse_m),
                match.verification,
            )
            for match in found
        ]

    def overlaps(self, source: PreparedScan, targets: Sequence[PreparedScan]) -> Float[np.ndarray, " n"]:
        """Asks the overlap head; see `Matcher`.

        Args:
            source: a prepared scan.
            targets: the others.

        Returns:
            The probabilities.
        """
        return np.asarray(overlap_pairs(self._model, [source] * len(targets), targets))


def _merged(submap: Submap) -> PreparedScan:
    """Merges descriptors; the number of scans is filled up to a power of two, so that few programs are compiled."""
    first: PreparedScan = submap.descriptions[0]
    num = len(submap.descriptions)
    if num == 1:
        return first
    capacity = 1 << (num - 1).bit_length()
    clouds = [description.descriptors for description in submap.descriptions]
    clouds += [_without_points(clouds[0])] * (capacity - num)
    T_submap_scan = np.concatenate([submap.T_submap_keyframe, np.tile(np.eye(4), (capacity - num, 1, 1))])
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *clouds)
    return PreparedScan(merge_clouds(stacked, jnp.asarray(T_submap_scan, jnp.float32)), first.measured)


def _without_points(cloud: DescriptorCloud) -> DescriptorCloud:
    return replace(cloud, mask=jnp.zeros_like(cloud.mask))

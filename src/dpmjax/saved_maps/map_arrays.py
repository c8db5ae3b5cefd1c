"""A keyframe map as named arrays, and back. Ragged arrays are concatenated, with the rows of each keyframe."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from dpmjax.deeppointmap.compact_scans import CompactScan, round_features
from dpmjax.saved_maps.map_coding import (
    NUM_ELEMENTS,
    ElementCodes,
    FeatureCodes,
    Precision,
    decode_elements,
    decode_features,
    encode_elements,
    encode_features,
)
from dpmjax.scans.compact import CompactElements, CompactImage
from dpmjax.slam.config import MapOrigin
from dpmjax.slam.keyframes import EdgeKind, Keyframe, KeyframeMap, MapEdge, orthonormal

KINDS: tuple[EdgeKind, ...] = get_args(EdgeKind)
TRIANGLE = np.triu_indices(6)
MAX_ROTATION_ERROR = 1e-4
NUMBERS = {"scan": np.int64, "segment": np.int32, "path_m": np.float64, "extent_m": np.float64}
"""Numbers of a keyframe, and their types in the file."""

Arrays = dict[str, NDArray[Any]]


class ArrayReader:
    """Arrays of a file, taken with a check of shape and kind.

    Args:
        arrays: by name.
    """

    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays

    def take(self, name: str, *shape: int | None, kind: str = "f") -> NDArray[Any]:
        """Returns an array.

        Args:
            name: name of the array.
            *shape: expected sizes; None for any.
            kind: expected kind of its numbers, as NumPy abbreviates it; several letters allow several.

        Returns:
            The array.

        Raises:
            ValueError: if it is missing, or of another shape or kind.
        """
        if name not in self._arrays:
            raise ValueError(f"{name} is missing")
        array = self._arrays[name]
        is_right = array.ndim == len(shape) and array.dtype.kind in kind
        if not is_right or any(a is not None and a != b for a, b in zip(shape, array.shape, strict=True)):
            expected = ", ".join("any" if size is None else str(size) for size in shape)
            raise ValueError(f"{name}: expected shape ({expected}), got {array.shape} {array.dtype}")
        return array


def pack_graph(slam_map: KeyframeMap, precision: Precision) -> Arrays:
    """Makes the arrays of poses and edges.

    Args:
        slam_map: the map.
        precision: "float32" keeps float64 poses exactly; others round them to float32.

    Returns:
        The arrays by name.
    """
    dtype = np.float64 if precision == "float32" else np.float32
    edges = slam_map.edges

    def poses(T: Iterable[NDArray[Any]]) -> NDArray[Any]:
        return np.array([pose[:3] for pose in T], dtype).reshape(-1, 3, 4)

    return {
        **{name: slam_map.column(name).astype(kind) for name, kind in NUMBERS.items()},
        "T_odometry_keyframe": poses(slam_map.column("T_odometry_keyframe")),
        "T_world_keyframe": poses(slam_map.T_world_keyframe),
        "vectors": slam_map.vectors.astype(np.float32 if precision == "float32" else np.float16),
        "edge_rows": np.array([edge[:2] for edge in edges], np.int32).reshape(-1, 2),
        "edge_kind": np.array([KINDS.index(edge.kind) for edge in edges], np.uint8),
        "edge_T": poses(edge.T_target_source for edge in edges),
        "edge_information": np.array([edge.information[TRIANGLE] for edge in edges], dtype).reshape(-1, 21),
    }


def unpack_graph(reader: ArrayReader, scans: Sequence[CompactScan], origin: MapOrigin) -> KeyframeMap:
    """Makes the map.

    Args:
        reader: reader of arrays from `pack_graph`.
        scans: scans of the keyframes.
        origin: what made the map.

    Returns:
        The map.

    Raises:
        ValueError: if arrays are missing or do not fit together.
    """
    k = len(scans)
    numbers = {name: reader.take(name, k, kind=np.dtype(kind).kind) for name, kind in NUMBERS.items()}
    if numbers["extent_m"].min() <= 0 or numbers["scan"].min() < 0:
        raise ValueError("extent_m and scan: expected numbers above 0")
    T_odometry, T_world = (_poses(reader, name, k) for name in ("T_odometry_keyframe", "T_world_keyframe"))
    rows = reader.take("edge_rows", None, 2, kind="i")
    kinds = reader.take("edge_kind", len(rows), kind="u")
    if rows.min(initial=0) < 0 or rows.max(initial=-1) >= k or kinds.max(initial=0) >= len(KINDS):
        raise ValueError(f"edge_rows and edge_kind: expected rows of {k} keyframes and {len(KINDS)} kinds")
    information = np.zeros((len(rows), 6, 6))
    information[:, *TRIANGLE] = information[:, *TRIANGLE[::-1]] = reader.take("edge_information", len(rows), 21)
    columns = zip(*(array.tolist() for array in numbers.values()), T_odometry, scans, strict=True)
    edges = zip(*rows.T.tolist(), _poses(reader, "edge_T", len(rows)), information, kinds, strict=True)
    return KeyframeMap(
        tuple(
            Keyframe(scan, T, path_m, segment, extent_m, kept) for scan, segment, path_m, extent_m, T, kept in columns
        ),
        T_world,
        reader.take("vectors", k, None).astype(np.float32),
        tuple(MapEdge(source, target, T, matrix, KINDS[kind]) for source, target, T, matrix, kind in edges),
        origin,
    )


def _poses(reader: ArrayReader, name: str, count: int) -> NDArray[np.float64]:
    stored = reader.take(name, count, 3, 4)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3] = stored
    products = T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    if np.abs(products - np.eye(3)).max(initial=0) > MAX_ROTATION_ERROR or (np.linalg.det(T) < 0).any():
        raise ValueError(f"{name}: expected rotations")
    if stored.dtype == np.float64:
        return T
    return np.array([orthonormal(pose) for pose in T]).reshape(-1, 4, 4)


def pack_scans(scans: Sequence[CompactScan], precision: Precision) -> Arrays:
    """Makes the arrays of the compact scans.

    Args:
        scans: scans, at least one, of one number of descriptors and channels.
        precision: see `save_map`.

    Returns:
        The arrays by name.
    """
    num_elements = max(len(scan.elements.mask) for scan in scans)
    if precision == "int8":
        num_elements = min(num_elements, max(NUM_ELEMENTS, scans[0].features.shape[0]))
    elements = [_of_length(scan.elements, num_elements) for scan in scans]
    arrays = {"directions": np.stack([scan.directions for scan in scans]), **_pack_images(scans)}
    if precision == "int8":
        features = np.concatenate([scan.features * scan.feature_steps[:, None] for scan in scans])
        codes_of = {"feature": encode_features(features)._asdict(), "element": encode_elements(elements)._asdict()}
        return arrays | {
            f"{name}_{field}": np.asarray(value) for name, codes in codes_of.items() for field, value in codes.items()
        }
    arrays |= {name: np.stack([getattr(scan, name) for scan in scans]) for name in ("features", "feature_steps")}
    return arrays | {
        f"element_{name}": np.stack([getattr(one, name) for one in elements]) for name in CompactElements._fields
    }


def unpack_scans(reader: ArrayReader, precision: Precision) -> list[CompactScan]:
    """Makes the compact scans.

    Args:
        reader: reader of arrays from `pack_scans`.
        precision: that was given to `pack_scans`.

    Returns:
        The scans.

    Raises:
        ValueError: if arrays are missing or do not fit together.
    """
    directions = reader.take("directions", None, None, kind="i")
    mask = reader.take("element_mask", None, None, kind="b")
    (k, m), (_, n) = directions.shape, mask.shape
    if k == 0 or len(mask) != k or m > n:
        raise ValueError(f"element_mask: expected rows of {k} keyframes with {m} descriptors or more, got {mask.shape}")
    if precision == "int8":
        codes = ElementCodes(
            reader.take("element_positions", k, 3, n, kind="i"),
            reader.take("element_normals", k, 2, n, kind="i"),
            reader.take("element_planarity", k, n, kind="u"),
            mask,
        )
        elements = decode_elements(codes)
        features = decode_features(_feature_codes(reader, k * m)).reshape(k, m, -1)
        rounded = [round_features(one) for one in features]
    else:
        columns = zip(
            reader.take("element_unit_m", k).tolist(),
            reader.take("element_positions", k, n, 3, kind="i"),
            reader.take("element_normals", k, n, 3, kind="i"),
            reader.take("element_planarity", k, n, kind="u"),
            mask,
            strict=True,
        )
        elements = [CompactElements(*parts) for parts in columns]
        steps = reader.take("feature_steps", k, m)
        rounded = list(zip(reader.take("features", k, m, None, kind="i"), steps, strict=True))
    parts_of_scans = zip(elements, rounded, directions, _unpack_images(reader, k), strict=True)
    return [CompactScan(one, *features_of, angles, image) for one, features_of, angles, image in parts_of_scans]


def _of_length(elements: CompactElements, num_elements: int) -> CompactElements:
    """Keeps the first elements, and fills up with elements that are not there."""
    kept = [array[:num_elements] for array in elements[1:]]
    missing = num_elements - len(kept[-1])
    padded = (np.pad(array, [(0, missing), *[(0, 0)] * (array.ndim - 1)]) for array in kept)
    return CompactElements(elements.unit_m, *padded)


def _feature_codes(reader: ArrayReader, num_descriptors: int) -> FeatureCodes:
    codes = reader.take("feature_codes", None, num_descriptors, kind="i")
    mean = reader.take("feature_mean", None)
    basis = reader.take("feature_basis", len(codes), len(mean)).astype(np.float32)
    return FeatureCodes(mean, basis, float(reader.take("feature_step")), codes)


def _pack_images(scans: Sequence[CompactScan]) -> Arrays:
    images = [scan.image for scan in scans]
    return {
        "image_count": np.array([len(image.nearest) for image in images], np.int32),
        "image_num_rows": np.array([image.num_rows for image in images], np.int32),
        "image_first_row": np.array([image.first_row for image in images], np.int32),
        "image_nearest": np.concatenate([image.nearest for image in images]),
        "image_farthest": np.concatenate([image.farthest for image in images]),
    }


def _unpack_images(reader: ArrayReader, k: int) -> list[CompactImage]:
    counts, num_rows, first_rows = (
        reader.take(f"image_{name}", k, kind="iu").astype(np.int64) for name in ("count", "num_rows", "first_row")
    )
    if (np.minimum(counts, first_rows) < 0).any() or (first_rows + counts > num_rows).any() or num_rows.max() > 1 << 16:
        raise ValueError("image_count and image_first_row: expected rows within the image")
    nearest = reader.take("image_nearest", int(counts.sum()), None, kind="u")
    farthest = reader.take("image_farthest", *nearest.shape, kind="u")
    parts = (np.split(codes, np.cumsum(counts)[:-1]) for codes in (nearest, farthest))
    return [CompactImage(*image) for image in zip(num_rows.tolist(), first_rows.tolist(), *parts, strict=True)]

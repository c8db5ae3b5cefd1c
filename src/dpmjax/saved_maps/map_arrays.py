"""A keyframe map as named arrays, and back: exactly, or as codes of few bytes for the smallest maps.

Coded features are written in the basis of their principal components (a few hold nearly all variance). All coefficients
are rounded to one step. Coded surface elements are rounded to centimetres. Ragged arrays are concatenated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int8
from numpy.typing import NDArray

from dpmjax.deeppointmap.compact_scans import MAX_COMPONENT, CompactElements, CompactImage, CompactScan, round_features
from dpmjax.geometry.se3 import orthonormal
from dpmjax.slam.keyframe_map import EdgeKind, Keyframe, KeyframeMap, MapEdge, MapOrigin, edge_arrays

Precision = Literal["float32", "int8"]
KINDS: tuple[EdgeKind, ...] = get_args(EdgeKind)
TRIANGLE = np.triu_indices(6)
MAX_ROTATION_ERROR = 1e-4
# Numbers of a keyframe, and their types in the file.
NUMBERS = {"scan": np.int64, "segment": np.int32, "path_m": np.float64, "extent_m": np.float64}

# Number of surface elements of a keyframe, or of its descriptors if it has more: localisation gains more from further
# keyframes than from further elements.
NUM_ELEMENTS = 256

POSITION_STEP_M = 0.02
PLANARITY_STEP = 17
MAX_CODE = np.iinfo(np.int8).max
# Coarse codes of ranges, as multiples of those of a `CompactImage`: 4 %, where free space has a margin of 10 %.
IMAGE_STEP = 2

MAX_IMAGE_ROWS = 1 << 16

Arrays = dict[str, NDArray[Any]]


def pack_map(slam_map: KeyframeMap, precision: Precision) -> Arrays:
    """Makes the arrays of a map.

    Args:
        slam_map: map with at least one keyframe; all scans have one number of descriptors and channels.
        precision: see `save_map`; "float32" keeps the float64 poses exactly, "int8" rounds them to float32.

    Returns:
        The arrays by name.
    """
    dtype = np.float64 if precision == "float32" else np.float32
    edges = edge_arrays(slam_map.edges)
    graph = {
        **{name: slam_map.column(name).astype(kind) for name, kind in NUMBERS.items()},
        "T_odometry_keyframe": slam_map.column("T_odometry_keyframe")[:, :3].astype(dtype),
        "T_world_keyframe": slam_map.T_world_keyframe[:, :3].astype(dtype),
        "vectors": slam_map.vectors if precision == "float32" else _encode_vectors(slam_map.vectors),
        "edge_rows": np.stack([edges.source, edges.target], axis=1).astype(np.int32),
        "edge_kind": np.array([KINDS.index(edge.kind) for edge in slam_map.edges], np.uint8),
        "edge_T": edges.measurements[:, :3].astype(dtype),
        "edge_information": edges.information[:, *TRIANGLE].astype(dtype, order="C"),
    }
    return graph | _pack_scans([keyframe.compact for keyframe in slam_map.keyframes], precision)


def unpack_map(arrays: Arrays, precision: Precision, origin: MapOrigin) -> KeyframeMap:
    """Makes the map.

    Args:
        arrays: arrays from `pack_map`; others may be among them.
        precision: precision that was given to `pack_map`.
        origin: matcher and settings that made the map.

    Returns:
        The map.

    Raises:
        ValueError: if arrays are missing or do not fit together.
    """
    scans = _unpack_scans(arrays, precision)
    k = len(scans)
    numbers = {name: _take(arrays, name, k, kind=np.dtype(kind).kind) for name, kind in NUMBERS.items()}
    if numbers["extent_m"].min() <= 0 or numbers["scan"].min() < 0:
        raise ValueError("extent_m and scan: expected numbers above 0")
    T_odometry, T_world = (_poses(arrays, name, k) for name in ("T_odometry_keyframe", "T_world_keyframe"))
    rows = _take(arrays, "edge_rows", None, 2, kind="i")
    kinds = _take(arrays, "edge_kind", len(rows), kind="u")
    if rows.min(initial=0) < 0 or rows.max(initial=-1) >= k or kinds.max(initial=0) >= len(KINDS):
        raise ValueError(f"edge_rows and edge_kind: expected rows of {k} keyframes and {len(KINDS)} kinds")
    information = np.zeros((len(rows), 6, 6))
    information[:, *TRIANGLE] = information[:, *TRIANGLE[::-1]] = _take(arrays, "edge_information", len(rows), 21)
    scan, segment, path_m, extent_m = (array.tolist() for array in numbers.values())
    keyframes = map(Keyframe, scan, T_odometry, path_m, segment, extent_m, scans)
    T_edges = _poses(arrays, "edge_T", len(rows))
    edges = map(MapEdge, *rows.T.tolist(), T_edges, information, [KINDS[kind] for kind in kinds])
    vectors = _unit_vectors(_take(arrays, "vectors", k, None, kind="fi"))
    return KeyframeMap(tuple(keyframes), T_world, vectors, tuple(edges), origin)


def _poses(arrays: Arrays, name: str, count: int) -> NDArray[np.float64]:
    stored = _take(arrays, name, count, 3, 4)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3] = stored
    products = T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    if np.abs(products - np.eye(3)).max(initial=0) > MAX_ROTATION_ERROR or (np.linalg.det(T) < 0).any():
        raise ValueError(f"{name}: expected rotations")
    return T if stored.dtype == np.float64 else np.array([orthonormal(pose) for pose in T]).reshape(-1, 4, 4)


def _pack_scans(scans: Sequence[CompactScan], precision: Precision) -> Arrays:
    num_elements = max(len(scan.elements.mask) for scan in scans)
    if precision == "int8":
        num_elements = min(num_elements, max(NUM_ELEMENTS, scans[0].features.shape[0]))
    padded = [_of_length(scan.elements, num_elements) for scan in scans]
    elements = [np.stack(parts) for parts in zip(*padded, strict=True)]
    names = "features", "feature_steps", "directions"
    features, steps, directions = (np.stack([getattr(scan, name) for scan in scans]) for name in names)
    arrays = {"directions": directions, **_pack_images(scans, IMAGE_STEP if precision == "int8" else 1)}
    if precision == "int8":
        exact = (features * steps[..., None]).reshape(-1, features.shape[-1])
        return arrays | _encode_features(exact) | _encode_elements(elements)
    named = zip(CompactElements._fields, elements, strict=True)
    arrays |= {"features": features, "feature_steps": steps}
    return arrays | {f"element_{name}": array for name, array in named}


def _unpack_scans(arrays: Arrays, precision: Precision) -> list[CompactScan]:
    directions = _take(arrays, "directions", None, None, kind="i")
    mask = _take(arrays, "element_mask", None, None, kind="b")
    (k, m), (_, n) = directions.shape, mask.shape
    if k == 0 or len(mask) != k or m > n:
        raise ValueError(f"element_mask: expected rows of {k} keyframes with {m} descriptors or more, got {mask.shape}")
    if precision == "int8":
        elements = _decode_elements(arrays, k, n)
        features, steps = round_features(_decode_features(arrays, k * m).reshape(k, m, -1))
    else:
        elements = (
            _take(arrays, "element_unit_m", k).tolist(),
            _take(arrays, "element_positions", k, n, 3, kind="i"),
            _take(arrays, "element_normals", k, n, 3, kind="i"),
            _take(arrays, "element_planarity", k, n, kind="u"),
        )
        steps, features = _take(arrays, "feature_steps", k, m), _take(arrays, "features", k, m, None, kind="i")
    elements_of_scans = map(CompactElements, *elements, mask)
    return list(map(CompactScan, elements_of_scans, features, steps, directions, _unpack_images(arrays, k)))


def _of_length(elements: CompactElements, num_elements: int) -> CompactElements:
    """Keeps the first elements, or pads with masked ones."""
    kept = [array[:num_elements] for array in elements[1:]]
    missing = num_elements - len(kept[-1])
    padded = (np.pad(array, [(0, missing), *[(0, 0)] * (array.ndim - 1)]) for array in kept)
    return CompactElements(elements.unit_m, *padded)


def _encode_features(features: Float[np.ndarray, "d c"]) -> Arrays:
    """Rounds features to coefficients of principal components: `mean + step * codes.T @ basis`."""
    mean = features.mean(axis=0, dtype=np.float64) if len(features) else np.zeros(features.shape[1])
    centred = features - mean
    variances, axes = np.linalg.eigh(centred.T @ centred / max(len(features), 1))
    # Largest number of principal components.
    basis = axes[:, ::-1][:, :16].T
    coefficients = basis @ centred.T
    largest = float(np.abs(coefficients).max(initial=0))
    # Step of the coefficients, as a share of the standard deviation of a channel.
    step = max(0.7 * float(np.sqrt(max(variances.mean(), 0))), largest / MAX_CODE, 1e-12)
    codes = np.rint(coefficients / step).astype(np.int8)
    is_used = codes.any(axis=1)
    return {
        "feature_mean": mean.astype(np.float32),
        "feature_basis": basis[is_used].astype(np.float16),
        "feature_step": np.asarray(step),
        "feature_codes": codes[is_used],
    }


def _decode_features(arrays: Arrays, num_descriptors: int) -> Float[np.ndarray, "d c"]:
    codes = _take(arrays, "feature_codes", None, num_descriptors, kind="i")
    mean = _take(arrays, "feature_mean", None)
    basis = _take(arrays, "feature_basis", len(codes), len(mean)).astype(np.float32)
    return (codes.T.astype(np.float32) * np.float32(_take(arrays, "feature_step"))) @ basis + mean


def _encode_vectors(vectors: Float[np.ndarray, "k c"]) -> Int8[np.ndarray, "k c"]:
    """Rounds each vector to steps of its largest component."""
    return np.rint(vectors * (MAX_CODE / np.abs(vectors).max(axis=1, keepdims=True, initial=1e-12))).astype(np.int8)


def _unit_vectors(stored: NDArray[Any]) -> Float[np.ndarray, "k c"]:
    vectors = stored.astype(np.float32)
    if stored.dtype.kind == "f":
        return vectors
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1)


def _encode_elements(elements: Sequence[NDArray[Any]]) -> Arrays:
    """Rounds positions to 2 cm, normals to two octahedral coordinates (Meyer et al. 2010), planarity to 16 steps."""
    unit_m, positions, normals, planarity, mask = elements
    upward = normals * np.where(normals[..., 2:] < 0, -1.0, 1.0)
    flat = upward[..., :2] / np.maximum(np.abs(upward).sum(axis=-1, keepdims=True), 1)
    positions = np.rint(positions.swapaxes(1, 2) * (unit_m / POSITION_STEP_M)[:, None, None])
    return {
        "element_positions": positions.astype(np.int16),
        "element_normals": np.rint(flat.swapaxes(1, 2) * MAX_COMPONENT).astype(np.int8),
        "element_planarity": np.rint(planarity / PLANARITY_STEP).astype(np.uint8),
        "element_mask": mask,
    }


def _decode_elements(arrays: Arrays, k: int, n: int) -> tuple[Any, ...]:
    """Returns the units, positions, normals and planarities of k scans, as in `CompactElements`."""
    positions = _take(arrays, "element_positions", k, 3, n, kind="i").astype(np.int16)
    planarity = _take(arrays, "element_planarity", k, n, kind="u").astype(np.int64)
    x, y = _take(arrays, "element_normals", k, 2, n, kind="i").swapaxes(0, 1) / MAX_COMPONENT
    normals = np.stack([x, y, np.maximum(1 - (np.abs(x) + np.abs(y)), 0)], axis=-1)
    normals = np.rint(normals / np.linalg.norm(normals, axis=-1, keepdims=True) * MAX_COMPONENT)
    normals = np.where(planarity[..., None] > 0, normals, 0).astype(np.int8)
    planarity = np.minimum(planarity * PLANARITY_STEP, 255).astype(np.uint8)
    return [POSITION_STEP_M] * k, positions.swapaxes(1, 2), normals, planarity


def _pack_images(scans: Sequence[CompactScan], step: int) -> Arrays:
    """Rounds near ranges down and far ranges up, so that the free space of a scan never grows."""
    images = [scan.image for scan in scans]
    farthest = np.concatenate([image.farthest for image in images])
    return {
        "image_step": np.asarray(step),
        "image_count": np.array([len(image.nearest) for image in images], np.int32),
        "image_num_rows": np.array([image.num_rows for image in images], np.int32),
        "image_first_row": np.array([image.first_row for image in images], np.int32),
        "image_nearest": np.concatenate([image.nearest for image in images]) // step,
        "image_farthest": farthest // step + (farthest % step > 0),
    }


def _unpack_images(arrays: Arrays, k: int) -> list[CompactImage]:
    counts, num_rows, first_rows = (
        _take(arrays, f"image_{name}", k, kind="iu").astype(np.int64) for name in ("count", "num_rows", "first_row")
    )
    if (
        (np.minimum(counts, first_rows) < 0).any()
        or (first_rows + counts > num_rows).any()
        or num_rows.max() > MAX_IMAGE_ROWS
    ):
        raise ValueError("image_count and image_first_row: expected rows within the image")
    nearest = _take(arrays, "image_nearest", int(counts.sum()), None, kind="u")
    farthest = _take(arrays, "image_farthest", *nearest.shape, kind="u")
    step = int(_take(arrays, "image_step", kind="i")) if "image_step" in arrays else 1
    largest = np.iinfo(np.uint8).max
    coarse = (np.minimum(codes.astype(np.int64) * step, largest).astype(np.uint8) for codes in (nearest, farthest))
    parts = (np.split(codes, np.cumsum(counts)[:-1]) for codes in coarse)
    return [CompactImage(*image) for image in zip(num_rows.tolist(), first_rows.tolist(), *parts, strict=True)]


def _take(arrays: Arrays, name: str, *shape: int | None, kind: str = "f") -> NDArray[Any]:
    """Returns an array of a file; its shape may be None for any size, and several letters allow several kinds."""
    if name not in arrays:
        raise ValueError(f"{name} is missing")
    array = arrays[name]
    is_right = array.ndim == len(shape) and array.dtype.kind in kind
    if not is_right or any(a is not None and a != b for a, b in zip(shape, array.shape, strict=True)):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name}: expected shape ({expected}), got {array.shape} {array.dtype}")
    return array

"""Arrays in files: of NumPy, variables of MATLAB, and depth images of 16 bits in PNG files."""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.files import read_bytes, refusing
from dpmjax.sequences import require

# A part of a file that unpacks to more than this many times its size has a wrong header: deflate reaches 1032.
_LARGEST_COMPRESSION = 1100
_MOST_PIXELS = 1 << 26
# Codes of MATLAB's files: data elements, categories of arrays, and storage of numbers and text.
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE = range(1, 6)
_STORAGE = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_STORAGE |= {16: "u1", 17: "u2"}


def to_float32(values: ArrayLike) -> NDArray[np.float32]:
    """Converts values to float32; values beyond its range become infinite, without a warning."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values).astype(np.float32)


def load_arrays(path: str | Path, keys: Sequence[str] | None = None) -> dict[str, NDArray[np.generic]]:
    """Reads a NumPy file; never fills more memory than the size of the file allows.

    Args:
        path: `.npy` or `.npz`; the first bytes decide.
        keys: names of the arrays to read from an `.npz`; None reads all.

    Returns:
        The arrays by name; the one of an `.npy` is called "points".

    Raises:
        InputError: no such file, no NumPy file, a damaged one, or one of Python objects.
    """
    require(Path(path).exists(), path, "no such file", "check the path")
    found, advice = "not a readable NumPy file ({error})", "save it again with numpy.save or numpy.savez"
    # The parsers of zip, zlib and NumPy headers raise many kinds of errors.
    with refusing(path, found, advice, (Exception,)), Path(path).open("rb") as file:
        if file.read(6) == npy_format.MAGIC_PREFIX:
            file.seek(0)
            return {"points": _parse_npy(file.read())}
        with zipfile.ZipFile(file) as archive:
            members = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            chosen = [key for key in (members if keys is None else keys) if key in members]
            return {key: _parse_npy(archive.read(members[key])) for key in chosen}


def _parse_npy(content: bytes) -> NDArray[np.generic]:
    """Parses the bytes of an `.npy`; raises a ValueError for Python objects, and for more rows than bytes."""
    values = npy_format.read_array(io.BytesIO(content), allow_pickle=False)
    if max(values.shape, default=0) > len(content) + 65536:
        raise ValueError(f"an array of {values.shape}")
    return values


def parse_mat(content: bytes, source: str | Path) -> dict[str, Any]:
    """Reads the variables of a MATLAB file. SciPy's reader ends the process on some damaged files.

    Args:
        content: the whole file.
        source: its name, for messages.

    Returns:
        Arrays and text by name; a struct array is a list of dictionaries, a cell array a list.

    Raises:
        InputError: no such file format, or a damaged file.
    """
    # Damage shows as one of many kinds of errors.
    found, advice = "not a readable MATLAB file ({kind})", "save it again with -v7, or remove it"
    with refusing(source, found, advice, (Exception,)):
        order = {b"IM": "<", b"MI": ">"}[content[126:128]]
        bodies = [body for kind, body in _elements(content[128:], order) if kind == _MATRIX]
        return dict(_parse_matrix(body, order) for body in bodies)


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yields type and content of each data element, unpacked; raises a ValueError where one exceeds its container."""
    while len(data):
        kind, size = struct.unpack(f"{order}II", data[:8])
        start, end = 8, 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if kind >> 16:  # The short form: type, size and four bytes of content in eight bytes.
            kind, size, start, end = kind & 0xFFFF, kind >> 16, 4, 8
        if start + size > len(data) or (end == 8 and size > 4):
            raise ValueError("an element is longer than the file")
        if kind == _COMPRESSED:
            limit = _LARGEST_COMPRESSION * (size + 64)
            yield from _elements(zlib.decompressobj().decompress(data[start : start + size], limit), order)
        else:
            yield kind, data[start : start + size]
        data = data[end:]


def _parse_matrix(data: bytes, order: str) -> tuple[str, Any]:
    """Parses name and value of a matrix element."""
    if not data:
        return "", np.zeros(0)
    (_, flags), (_, size), (_, name), *parts = _elements(data, order)
    shape = tuple(np.frombuffer(size, f"{order}i4").tolist())
    category = struct.unpack(f"{order}I", flags[:4])[0] & 0xFF
    return name.decode("latin-1"), _parse_value(category, parts, shape, order)


def _parse_value(category: int, parts: list[tuple[int, bytes]], shape: tuple[int, ...], order: str) -> Any:
    if category == _CELL:
        return [_parse_matrix(body, order)[1] for _, body in parts]
    if category == _STRUCT:
        width = int(_numbers(parts[0], order)[0])
        words = [parts[1][1][i : i + width] for i in range(0, len(parts[1][1]), width)]
        names = [word.partition(b"\0")[0].decode("latin-1") for word in words]
        values = [_parse_matrix(body, order)[1] for _, body in parts[2:]]
        if len(values) != math.prod(shape) * len(names):
            raise ValueError("fields are missing")
        return [dict(zip(names, values[i : i + len(names)], strict=True)) for i in range(0, len(values), len(names))]
    if category in (_OBJECT, _SPARSE) or min(shape) < 0:
        raise ValueError("neither numbers nor text")
    numbers = _numbers(parts[0], order) if parts else np.zeros(0)
    if category == _CHAR:
        return "".join(map(chr, numbers.tolist()))
    return numbers[: math.prod(shape)].reshape(shape, order="F")


def _numbers(element: tuple[int, bytes], order: str) -> NDArray[Any]:
    return np.frombuffer(element[1], order + _STORAGE[element[0]])


def read_depth_png(path: str | Path) -> NDArray[np.int64]:
    """Reads the 16-bit numbers of a one-channel PNG.

    Args:
        path: the picture.

    Returns:
        (rows, columns).

    Raises:
        InputError: the file is missing, damaged, or has another kind of pixels.
    """
    from matplotlib.image import imread

    content, advice = read_bytes(path), "copy the picture again"
    is_png = content.startswith(b"\x89PNG\r\n\x1a\n") and len(content) >= 25
    require(is_png, path, "not a readable PNG (no PNG header)", advice)
    width, height, bits = struct.unpack(">IIB", content[16:25])
    is_small = 0 < width * height <= _MOST_PIXELS
    require(is_small, path, f"not a readable PNG (a size of {width} x {height})", advice)
    # Pillow raises many kinds of errors.
    with refusing(path, "not a readable PNG ({error})", advice, (Exception,)):
        image = np.asarray(imread(io.BytesIO(content), format="png"), np.float64)
    is_good = image.ndim == 2 and bits == 16
    require(is_good, path, f"pixels are {image.shape} of {bits} bits", "give a PNG of one channel of 16 bits")
    # matplotlib divides by the largest number of 16 bits.
    return np.rint(image * 65535.0).astype(np.int64)

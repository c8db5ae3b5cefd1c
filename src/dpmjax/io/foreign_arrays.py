"""Arrays in files of other programs: variables of MATLAB, and depth images of 16 bits in PNG files."""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import LARGEST_COMPRESSION, read_bytes, refusing
from dpmjax.sequences import FloatArray, require

_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE = range(1, 6)
_STORAGE = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_STORAGE |= {16: "u1", 17: "u2"}  # text


def parse_mat(content: bytes, source: str | Path) -> dict[str, Any]:
    """Reads the variables of a MATLAB file.

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
            limit = LARGEST_COMPRESSION * (size + 64)
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
    category, count = struct.unpack(f"{order}I", flags[:4])[0] & 0xFF, math.prod(shape)
    return name.decode("latin-1"), _parse_value(category, parts, shape, count, order)


def _parse_value(category: int, parts: list[tuple[int, bytes]], shape: tuple[int, ...], count: int, order: str) -> Any:
    if category == _CELL:
        return [_parse_matrix(body, order)[1] for _, body in parts]
    if category == _STRUCT:
        width = int(_numbers(parts[0], order)[0])
        words = [parts[1][1][i : i + width] for i in range(0, len(parts[1][1]), width)]
        names = [word.partition(b"\0")[0].decode("latin-1") for word in words]
        values = [_parse_matrix(body, order)[1] for _, body in parts[2:]]
        if len(values) != count * len(names):
            raise ValueError("fields are missing")
        return [dict(zip(names, values[i : i + len(names)], strict=True)) for i in range(0, len(values), len(names))]
    if category in (_OBJECT, _SPARSE) or min(shape) < 0:
        raise ValueError("neither numbers nor text")
    numbers = _numbers(parts[0], order) if parts else np.zeros(0)
    if category == _CHAR:
        return "".join(map(chr, numbers.tolist()))
    return numbers[:count].reshape(shape, order="F")


def _numbers(element: tuple[int, bytes], order: str) -> NDArray[Any]:
    return np.frombuffer(element[1], order + _STORAGE[element[0]])


_MOST_PIXELS = 1 << 26


def read_depth_png(path: str | Path) -> NDArray[np.int64]:
    """Reads the 16-bit numbers of a one-channel PNG.

    Args:
        path: the picture.

    Returns:
        (rows, columns).

    Raises:
        InputError: the file is missing, damaged, or has another kind of pixels.
    """
    image, bits = _read_png(path)
    is_good = image.ndim == 2 and bits == 16
    require(is_good, path, f"pixels are {image.shape} of {bits} bits", "give a PNG of one channel of 16 bits")
    # matplotlib divides by the largest number of 16 bits.
    return np.rint(image * 65535.0).astype(np.int64)


def _read_png(path: str | Path) -> tuple[FloatArray, int]:
    """Reads the picture with values in [0, 1], and the number of bits of a channel."""
    from matplotlib.image import imread

    content = read_bytes(path)
    # Pillow raises many kinds of errors.
    with refusing(path, "not a readable PNG ({error})", "copy the picture again", (Exception,)):
        if not content.startswith(b"\x89PNG\r\n\x1a\n"):
            raise ValueError("no PNG signature")
        width, height, bits = struct.unpack(">IIB", content[16:25])
        if not 0 < width * height <= _MOST_PIXELS:
            raise ValueError(f"a size of {width} x {height}")
        return np.asarray(imread(io.BytesIO(content), format="png"), np.float64), bits

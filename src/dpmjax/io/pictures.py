"""Depth images of 16 bits in PNG files."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import read_bytes, refusing
from dpmjax.sequences import FloatArray, require

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
    """The picture with values in [0, 1], and the bits of a channel."""
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

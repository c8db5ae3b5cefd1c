"""PNG files as data: depth images of 16 bits, and floor plans as worlds."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import read_bytes, refusing, write_atomically
from dpmjax.sequences import FloatArray, World, require

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


def read_world_png(path: str | Path) -> World:
    """Reads a floor plan: pixels darker than half are solid, the lowest picture row is row 0.

    Args:
        path: a PNG picture.

    Returns:
        The world; free pockets that cannot be reached from the largest free space are solid.

    Raises:
        InputError: the file is missing, no picture, or solid everywhere.
    """
    image, _ = _read_png(path)
    gray = image if image.ndim == 2 else image[..., : 1 if image.shape[2] < 3 else 3].mean(axis=2)
    is_obstacle = gray[::-1] < 0.5 * max(1.0, gray.max())
    require(not is_obstacle.all(), path, "no white pixel", "free space must be white, obstacles black")
    return World(Path(path).stem, is_obstacle).fill_pockets()


def write_world_png(path: str | Path, world: World) -> Path:
    """Saves the world as a picture: white is free, black is solid, y up as in a plot.

    Args:
        path: file to write, atomically.
        world: the world.

    Returns:
        The path.
    """
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, ~world.is_obstacle[::-1], cmap="gray", vmin=0, vmax=1, format="png")
    return write_atomically(path, buffer.getvalue())


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

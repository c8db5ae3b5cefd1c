"""Files as a whole: written completely or not at all, listed in the order in which a human counts."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path


def write_atomically(path: str | Path, content: bytes | str) -> Path:
    """Writes a file through a temporary neighbour, so that an interruption never leaves half of it.

    Missing parent folders are made.

    Args:
        path: where the file goes; an existing file is replaced.
        content: bytes, or text (written as UTF-8, lines end with a line feed alone).

    Returns:
        The path.

    Raises:
        OSError: the folder cannot be written; an existing file is then untouched.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path


def _umask() -> int:
    """The process's umask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which scan_2 comes before scan_10.

    Args:
        name: a file name or path.

    Returns:
        The name cut into numbers and text; numbers compare as numbers and come before text.
    """
    pieces = [piece for piece in re.split(r"(\d+)", name) if piece]
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces)

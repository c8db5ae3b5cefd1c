"""Files and folders in place of arrays: a pipeline reads the path that it gets, and no algorithm imports a reader."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TypeVar, cast

Given = TypeVar("Given")


def read_path(value: Given | str | Path, reader: str) -> Given:
    """Reads the value if it is a path, and returns any other value unchanged.

    The reader is imported by name when a path is given, because algorithms do not depend on files.

    Args:
        value: the argument of a pipeline.
        reader: package and name of the reader, such as "io.read_lidar_file".

    Returns:
        The argument that the pipeline works with.

    Raises:
        InputError: one line with the file, the finding and the advice.
    """
    if not isinstance(value, str | Path):
        return value
    room, _, name = reader.partition(".")
    return cast(Given, getattr(importlib.import_module(f"dpmjax.{room}"), name)(value))

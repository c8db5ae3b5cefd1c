"""Point clouds of files: the layout of their records, and the columns that are read out of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import unpack_rows

PADDING = "_"
"""Name of padding fields of the Point Cloud Library."""
# Names of columns of point times of lidar drivers and data sets.
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "time_offset", "offset_time", "gps_time")


class CloudLayout(NamedTuple):
    """The header of a file of points.

    Attributes:
        fields: names of the fields; a name may occur twice.
        layout: one record; its fields are called "0", "1" and so on, and are arrays.
        num_points: number of records.
        encoding: encoding of the body, as the header names it.
        size: bytes of the header.
        num_lines: lines of the header.
    """

    fields: list[str]
    layout: np.dtype[np.void]
    num_points: int
    encoding: str
    size: int
    num_lines: int

    @property
    def widths(self) -> list[int]:
        """Number of values of each field."""
        return [math.prod(self.layout[index].shape) for index in range(len(self.fields))]

    @property
    def wanted(self) -> list[int]:
        """Indices of the fields with values."""
        return [i for i, width in enumerate(self.widths) if width > 0 and self.fields[i] != PADDING]


class TimedCloud(NamedTuple):
    """Points of a file and their times.

    Attributes:
        points: (m, 3) float32 x, y, z in the file's unit; NaN where the file has it.
        times: (m,) in the unit and from the origin of the file; None without a column of a known name.
    """

    points: NDArray[np.float32]
    times: NDArray[np.float64] | None


def unpack_columns(body: bytes, header: CloudLayout, source: str) -> dict[str, NDArray[np.generic]]:
    """Reads the first number of each field out of binary records.

    Args:
        body: the records.
        header: their layout.
        source: name of the file, for messages.

    Returns:
        (num_points,) values by name; padding is left out.

    Raises:
        InputError: there are fewer records.
    """
    records = unpack_rows(body, header.layout, header.num_points, source)
    return {header.fields[i]: records[f"{i}"].reshape(len(records), header.widths[i])[:, 0] for i in header.wanted}


def times_of(columns: dict[str, NDArray[np.generic]]) -> NDArray[np.float64] | None:
    """Finds the column of times.

    Args:
        columns: values by name.

    Returns:
        (n,) in the unit of the file; None where no column has a known name.
    """
    name = find_time_field(columns)
    return None if name is None else np.asarray(columns[name], np.float64)


def find_time_field(names: Iterable[str]) -> str | None:
    """Finds the field of point times.

    Args:
        names: names of the fields.

    Returns:
        The first known name, None where there is none.
    """
    return next((name for name in names if name.lower() in _TIME_FIELDS), None)

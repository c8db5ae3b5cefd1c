"""Whole files: read with one-line errors, written completely or not at all, sorted by their numbers."""

from __future__ import annotations

import io
import math
import os
import re
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import ArrayLike, NDArray

from dpmjax.sequences import FloatArray, InputError, require

# A member of an archive that unpacks to more than this many times its size has a wrong header: deflate reaches 1032.
LARGEST_COMPRESSION = 1100


@contextmanager
def refusing(source: str | Path, found: str, advice: str, kinds: tuple[type[Exception], ...]) -> Iterator[None]:
    """Converts errors of a parser to an `InputError`.

    Args:
        source: see `InputError`.
        found: finding about the file; "{error}" in it becomes the parser's message, and "{kind}" the class of its
            error.
        advice: see `InputError`.
        kinds: the errors that damaged input can raise.

    Yields:
        Nothing.

    Raises:
        InputError: an error of one of these kinds was raised within.
    """
    try:
        yield
    except kinds as error:
        found = found.replace("{kind}", type(error).__name__).replace("{error}", str(error))
        raise InputError(source, found, advice) from error


def write_atomically(path: str | Path, content: bytes | str) -> Path:
    """Writes a file through a temporary neighbour, so that an interruption never leaves half of it.

    Missing parent folders are made.

    Args:
        path: where the file goes; an existing file is replaced.
        content: bytes, or text (written as UTF-8, lines end with a line feed alone).

    Returns:
        The path.

    Raises:
        BaseException: error of the writing, such as an OSError; an existing file is then unchanged.
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
    """Returns the umask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Returns a sort key under which scan_2 comes before scan_10.

    Args:
        name: a file name or path.

    Returns:
        The name cut into numbers and text; numbers compare as numbers and come before text.
    """
    pieces = [piece for piece in re.split(r"(\d+)", name) if piece]
    return tuple((0, int(p), "") if p.isdecimal() and len(p) < 100 else (1, 0, p) for p in pieces)


def read_bytes(path: str | Path) -> bytes:
    """Reads a whole file.

    Args:
        path: the file.

    Returns:
        Its bytes.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(path, "no such file", "check the path") from error
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path and its permissions") from error


def read_lines(path: str | Path) -> list[str]:
    """Reads the lines of a text file; bytes that are no UTF-8 are replaced.

    Args:
        path: the file.

    Returns:
        The lines without their ends.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    return read_bytes(path).decode("utf-8", errors="replace").splitlines()


def to_numbers(rows: Sequence[Sequence[str]], lines: Sequence[int], source: str | Path) -> FloatArray:
    """Converts words to numbers.

    Args:
        rows: n rows of k words each.
        lines: (n,) the line of each row in its file, from 1.
        source: name of the file, for messages.

    Returns:
        (n, k).

    Raises:
        InputError: there is no row, rows differ in length, or a word is no number; line and column are named.
    """
    require(len(rows) > 0, source, "no row", "write rows of numbers")
    wrong = next((i for i, row in enumerate(rows) if len(row) != len(rows[0])), None)
    if wrong is not None:
        found = f"line {lines[wrong]} has {len(rows[wrong])} columns, line {lines[0]} has {len(rows[0])}"
        raise InputError(source, found, "give rows of equal length")
    try:
        return np.array(rows, np.float64)
    except ValueError as error:
        words = ((line, column, word) for line, row in zip(lines, rows, strict=True) for column, word in enumerate(row))
        line, column, word = next(entry for entry in words if not _is_number(entry[2]))
        found = f"line {line}, column {column + 1}: {word[:40]!r} is not a number"
        raise InputError(source, found, "write plain decimal numbers") from error


def _is_number(word: str) -> bool:
    try:
        np.array([word], np.float64)
    except ValueError:
        return False
    return True


def read_table(path: str | Path) -> FloatArray:
    """Reads rows of numbers, separated by blanks or commas; empty lines and lines with # in front are left out.

    Args:
        path: the file.

    Returns:
        (n, k).

    Raises:
        InputError: there is no such file, no row, rows differ in length, or a word is no number.
    """
    lines = [(number, line) for number, line in enumerate(read_lines(path), 1) if line.strip()[:1] not in ("", "#")]
    return to_numbers([line.replace(",", " ").split() for _, line in lines], [number for number, _ in lines], path)


def unpack_rows(body: bytes, layout: np.dtype[np.void], count: int, source: str | Path) -> NDArray[Any]:
    """Reads binary records.

    Args:
        body: the bytes.
        layout: layout of one record.
        count: number of records that the header promises.
        source: name of the file, for messages.

    Returns:
        (count,) records, read-only.

    Raises:
        InputError: there are fewer bytes.
    """
    expected = count * layout.itemsize
    found = f"truncated: {count} points need {expected} bytes, {len(body)} are there"
    require(len(body) >= expected, source, found, "copy the file again")
    return np.frombuffer(body, layout, count=count)


def split_rows(body: bytes, width: int, count: int, source: str | Path, *, num_lines_before: int = 0) -> FloatArray:
    """Reads rows of numbers as text.

    Args:
        body: the bytes.
        width: numbers in a row.
        count: number of rows that the header promises; further rows are ignored.
        source: name of the file, for messages.
        num_lines_before: lines of the file before the body.

    Returns:
        (count, width).

    Raises:
        InputError: there are fewer rows, a row of another width, or a word that is no number; the line is named.
    """
    numbered = ((number, line.decode("latin-1").split()) for number, line in enumerate(body.splitlines(), 1))
    rows = [(number + num_lines_before, words) for number, words in numbered if words][:count]
    found = f"truncated: the header promises {count} points, {len(rows)} are there"
    require(len(rows) >= count, source, found, "copy the file again")
    wrong = next((row for row in rows if len(row[1]) != width), None)
    if wrong is not None:
        found = f"line {wrong[0]} has {len(wrong[1])} columns, the header promises {width}"
        raise InputError(source, found, "write one number per field in each row")
    if not count:
        return np.zeros((0, width))
    return to_numbers([words for _, words in rows], [number for number, _ in rows], source)


def to_float32(values: ArrayLike) -> NDArray[np.float32]:
    """Converts values to float32; values beyond its range become infinite, without a warning."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values).astype(np.float32)


def load_arrays(path: str | Path, keys: Sequence[str] | None = None) -> dict[str, NDArray[np.generic]]:
    """Reads a NumPy file; never allocates more than the size of the file allows.

    Args:
        path: `.npy` or `.npz`; the first bytes decide.
        keys: names of the arrays to read from an `.npz`; None reads all.

    Returns:
        The arrays by name; the one of an `.npy` is called "points". Arrays may be read-only.

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
            chosen = {key: members[key] for key in (members if keys is None else keys) if key in members}
            return {key: _parse_npy(_unpack(archive, member)) for key, member in chosen.items()}


def _unpack(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Unpacks a member; raises a ValueError where its stated size exceeds the limit of its packed size."""
    if member.file_size > LARGEST_COMPRESSION * (member.compress_size + 64):
        raise ValueError(f"{member.filename} claims {member.file_size} bytes, packed into {member.compress_size}")
    return archive.read(member)


def _parse_npy(content: bytes) -> NDArray[np.generic]:
    """Parses the bytes of an `.npy`."""
    stream = io.BytesIO(content)
    version = npy_format.read_magic(stream)
    read_header = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    shape, is_fortran, dtype = read_header(stream)
    if dtype.hasobject or min(shape, default=0) < 0:
        raise ValueError(f"an array of {shape} {dtype}")
    needed, present = math.prod(shape) * dtype.itemsize, len(content) - stream.tell()
    if needed > present or (needed == 0 and max(shape, default=0) > present + 65536):
        raise ValueError(f"truncated: an array of {shape} {dtype} needs {needed} bytes, {present} are there")
    if needed == 0:
        return np.zeros(shape, dtype)
    values = np.frombuffer(content, dtype, math.prod(shape), stream.tell())
    return values.reshape(shape, order="F" if is_fortran else "C")

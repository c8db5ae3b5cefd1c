"""Whole files as bytes, lines, tables and arrays: read with one-line errors, written completely or not at all.

Arrays are those of NumPy, variables of MATLAB (by SciPy), and depth images of 16 bits in PNG files.
"""

from __future__ import annotations

import codecs
import gzip
import importlib
import io
import logging
import os
import pickle
import re
import subprocess
import sys
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.sequences import FloatArray, InputError, Note, require

_log = logging.getLogger(__name__)
# SciPy's reader of MATLAB files ends the process on some damaged ones, so it runs in one of its own.
_LOAD_MAT = (
    "import io, pickle, sys, scipy.io; "
    "pickle.dump(scipy.io.loadmat(io.BytesIO(sys.stdin.buffer.read()), simplify_cells=True), sys.stdout.buffer)"
)


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
        InputError: the block raised an error of one of these kinds. An InputError passes unchanged.
    """
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        found = found.replace("{kind}", type(error).__name__).replace("{error}", str(error))
        raise InputError(source, found, advice) from error


def import_for(source: str | Path, module: str, extra: str) -> ModuleType:
    """Imports a module of an extra.

    Args:
        source: the file that needs it, for the message.
        module: name of the module.
        extra: extra of dpmjax, which brings its package.

    Returns:
        The module.

    Raises:
        InputError: the module cannot be imported.
    """
    package = module.partition(".")[0]
    with refusing(source, f"needs {package}, whose import fails", f"pip install 'dpmjax[{extra}]'", (Exception,)):
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            found = f"needs {package}, which is not installed"
            raise InputError(source, found, f"pip install 'dpmjax[{extra}]'") from error


def log_notes(notes: Iterable[Note]) -> None:
    """Logs doubts as warnings, and other notes as information.

    Args:
        notes: notes of a reader.
    """
    for note in notes:
        _log.log(logging.WARNING if note.is_doubt else logging.INFO, "%s", note.text)


def write_atomically(path: str | Path, content: bytes | str) -> Path:
    """Writes a file through a temporary neighbour, so that an interruption never leaves half of it.

    Missing parent folders are made.

    Args:
        path: where the file goes; an existing file is replaced.
        content: bytes, or text (written as UTF-8, lines end with a line feed alone; names of files that are no UTF-8
            keep their bytes).

    Returns:
        The path.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content.encode(errors="surrogateescape") if isinstance(content, str) else content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def natural_key(name: str, number: str = "[0-9]+") -> tuple[tuple[int, float, str], ...]:
    """Returns a sort key under which scan_2 comes before scan_10.

    Args:
        name: a file name or path.
        number: pattern of a number.

    Returns:
        The name cut into numbers and text; numbers compare as numbers and come before text.
    """
    pieces = [piece for piece in re.split(f"({number})", name) if piece]
    return tuple((0, float(p), p) if re.fullmatch(number, p) else (1, 0.0, p) for p in pieces)


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


def read_unpacked(path: str | Path) -> bytes:
    """Reads a whole file, plain or packed by gzip.

    Args:
        path: the file.

    Returns:
        Its bytes, unpacked.

    Raises:
        InputError: there is no such file, it cannot be read, or it is damaged.
    """
    content = read_bytes(path)
    if not content.startswith(b"\x1f\x8b"):
        return content
    with refusing(path, "cannot be unpacked ({error})", "copy the file again", (OSError, EOFError, zlib.error)):
        return gzip.decompress(content)


def read_lines(path: str | Path) -> list[str]:
    """Reads the lines of a text file in UTF-8, or UTF-16 with its mark in front; other bytes are replaced.

    Args:
        path: the file, plain or packed by gzip.

    Returns:
        The lines without their ends.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    content = read_unpacked(path)
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    return content.decode(encoding, errors="replace").splitlines()


def is_number(word: str) -> bool:
    """Returns True for a word that Python reads as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def to_numbers(lines: Sequence[str], source: str | Path) -> FloatArray:
    """Converts lines of numbers.

    Args:
        lines: n lines of k numbers, separated by blanks.
        source: name of the file, for messages.

    Returns:
        (n, k).

    Raises:
        InputError: there is no row, rows differ in length, or a word is no number; the row is named.
    """
    require(len(lines) > 0, source, "no row", "write rows of numbers")
    try:
        return np.loadtxt(lines, ndmin=2, comments=None)
    except ValueError as error:
        rows, width = [line.split() for line in lines], len(lines[0].split())
        bad = (n for n, words in enumerate(rows) if len(words) != width or not all(map(is_number, words)))
        row = next(bad, 0)
        found = f"row {row + 1} is not {width} numbers: {lines[row][:80]!r}"
        raise InputError(source, found, "write rows of one length, and plain decimal numbers") from error


def read_table(path: str | Path, width: int | None = None) -> FloatArray:
    """Reads rows of numbers, separated by blanks, commas or semicolons.

    Empty lines, lines with # in front, and one line of names above the numbers are left out.

    Args:
        path: the file.
        width: required numbers in a row, all finite; None: any.

    Returns:
        (n, k).

    Raises:
        InputError: there is no such file, no row, rows differ in length, a word is no number, or another width.
    """
    lines = [re.sub("[,;]", " ", line).strip() for line in read_lines(path)]
    lines = [line for line in lines if line and not line.startswith("#")]
    has_names = len(lines) > 1 and not any(map(is_number, lines[0].split()))
    table = to_numbers(lines[has_names:], path)
    is_good = width is None or (table.shape[1] == width and bool(np.isfinite(table).all()))
    found = f"rows of {table.shape[1]} numbers, or some not finite"
    require(is_good, path, found, f"give {width} finite numbers a row")
    return table


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
    content = read_bytes(path)
    require(len(content) > 0, path, "an empty file of 0 bytes", "copy it again")
    # The parsers of zip, zlib and NumPy headers raise many kinds of errors.
    advice = "save it again with numpy.save or numpy.savez"
    with refusing(path, "not a readable NumPy file ({error})", advice, (Exception,)):
        loaded = np.load(io.BytesIO(content), allow_pickle=False)
        table = {"points": loaded} if isinstance(loaded, np.ndarray) else loaded
        arrays = {key: table[key] for key in table if keys is None or key in keys or table is not loaded}
        for each in arrays.values():
            is_good = max(each.shape, default=0) <= each.nbytes + 65536
            require(is_good, path, f"not a readable NumPy file (an array of {each.shape})", advice)
    return arrays


def load_mat(content: bytes, source: str | Path) -> dict[str, Any]:
    """Reads the variables of a MATLAB file (of version 4 to 7) by `scipy.io.loadmat`.

    Args:
        content: the whole file.
        source: its name, for messages.

    Returns:
        Arrays, text and numbers by name, without axes of length one; a struct is a dictionary, an array of structs a
        list.

    Raises:
        InputError: SciPy cannot read the file, or it ends or keeps the process that reads it.
    """
    advice = "save it again with -v7, or remove it"
    with refusing(source, "not a readable MATLAB file ({kind})", advice, (Exception,)):
        command = [sys.executable, "-P", "-c", _LOAD_MAT]
        done = subprocess.run(command, input=content, capture_output=True, check=True, timeout=60)
        variables: dict[str, Any] = pickle.loads(done.stdout)
    return {name: value for name, value in variables.items() if not name.startswith("__")}


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

    content = read_bytes(path)
    # Pillow raises many kinds of errors, also for pictures that would fill the memory.
    with refusing(path, "not a readable PNG ({error})", "copy the picture again", (Exception,)):
        image = np.asarray(imread(io.BytesIO(content), format="png"), np.float64)
    found = f"pixels are {image.shape} of {content[24]} bits"
    require(image.ndim == 2 and content[24] == 16, path, found, "give a PNG of one channel of 16 bits")
    # matplotlib divides by the largest number of 16 bits.
    return np.rint(image * 65535.0).astype(np.int64)

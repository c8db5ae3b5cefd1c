"""Whole files: read with one-line errors, written completely or not at all, sorted by their numbers."""

from __future__ import annotations

import codecs
import importlib
import logging
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np

from dpmjax.sequences import FloatArray, InputError, Note, require

_log = logging.getLogger(__name__)


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
    try:
        return importlib.import_module(module)
    except Exception as error:  # a package may be broken in any way
        why = "which is not installed" if isinstance(error, ModuleNotFoundError) else "whose import fails"
        found = f"needs {module.partition('.')[0]}, {why}"
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
        content: bytes, or text (written as UTF-8, lines end with a line feed alone).

    Returns:
        The path.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


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
    """Reads the lines of a text file in UTF-8, or UTF-16 with its mark in front; other bytes are replaced.

    Args:
        path: the file.

    Returns:
        The lines without their ends.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    return to_lines(read_bytes(path))


def to_lines(content: bytes) -> list[str]:
    """Decodes the lines of a text; see `read_lines`.

    Args:
        content: the bytes of the text.

    Returns:
        The lines without their ends.
    """
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    return content.decode(encoding, errors="replace").splitlines()


def is_number(word: str, kind: type[int | float] = float) -> bool:
    """Returns True for a word that Python reads as a number of this kind."""
    try:
        kind(word)
    except ValueError:
        return False
    return True


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
    for line, row in zip(lines, rows, strict=True):
        found = f"line {line} has {len(row)} columns, line {lines[0]} has {len(rows[0])}"
        require(len(row) == len(rows[0]), source, found, "give rows of equal length")
    try:
        return np.array([[float(word) for word in row] for row in rows])
    except ValueError as error:
        words = ((line, column, word) for line, row in zip(lines, rows, strict=True) for column, word in enumerate(row))
        line, column, word = next(entry for entry in words if not is_number(entry[2]))
        found = f"line {line}, column {column + 1}: {word[:40]!r} is not a number"
        raise InputError(source, found, "write plain decimal numbers") from error


def read_table(path: str | Path) -> FloatArray:
    """Reads rows of numbers, separated by blanks, commas or semicolons.

    Empty lines, lines with # in front, and one line of names above the numbers are left out.

    Args:
        path: the file.

    Returns:
        (n, k).

    Raises:
        InputError: there is no such file, no row, rows differ in length, or a word is no number.
    """
    lines = [(number, re.sub("[,;]", " ", line).split()) for number, line in enumerate(read_lines(path), 1)]
    lines = [(number, words) for number, words in lines if words and words[0][:1] != "#"]
    if len(lines) > 1 and not any(map(is_number, lines[0][1])):
        lines = lines[1:]
    return to_numbers([words for _, words in lines], [number for number, _ in lines], path)

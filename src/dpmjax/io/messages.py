"""Messages of readers: notes in the log, and the error of a missing package."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from dpmjax.sequences import InputError, Note

_log = logging.getLogger(__name__)


def log_notes(notes: Iterable[Note]) -> None:
    """Logs doubts as warnings, and other notes as information.

    Args:
        notes: notes of a reader.
    """
    for note in notes:
        _log.log(logging.WARNING if note.is_doubt else logging.INFO, "%s", note.text)


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
        package = module.partition(".")[0]
        is_missing = isinstance(error, ModuleNotFoundError)
        found = f"needs {package}, which is not installed" if is_missing else f"needs {package}: its import fails"
        raise InputError(source, found, f"pip install 'dpmjax[{extra}]'") from error

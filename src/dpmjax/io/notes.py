"""Notes of readers in the log: decisions about the input, and doubts."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from dpmjax.sequences import Note

_log = logging.getLogger(__name__)


def log_notes(notes: Iterable[Note]) -> None:
    """Logs doubts as warnings, and other notes as information.

    Args:
        notes: notes of a reader.
    """
    for note in notes:
        _log.log(logging.WARNING if note.is_doubt else logging.INFO, "%s", note.text)

"""The one error of the readers: the user's input is not what was asked for."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Bad input, told in one line: which file, what was found there, what to do.

    The command line prints the line and ends with exit code 2; nothing has been written by then.

    Args:
        source: the file or folder at fault.
        found: what was found, without a final full stop.
        advice: what to do about it, without a final full stop.
    """

    def __init__(self, source: str | Path, found: str, advice: str) -> None:
        """Puts the line together."""
        self.source, self.found, self.advice = str(source), found, advice
        super().__init__(" ".join(f"{source}: {found}; {advice}.".split()))

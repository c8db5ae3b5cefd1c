"""Ctrl-C and SIGTERM as a flag that loops poll, so that a stopped run still writes what it has."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """The run was asked to stop by a signal."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal.Signals(signal_number).name)
        self.signal_number = signal_number

    @property
    def exit_code(self) -> int:
        """What a shell reports for a program ended by this signal: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signal_number


class StopFlag:
    """Turns the first signal into a flag; a second one interrupts at once.

        with StopFlag() as stop:
            while not stop.is_requested and step < num_steps:
                ...
            write_results()

    At the end of the block, after everything in it was written, a requested stop is raised as `Interrupted`, and the
    command ends with the exit code of the signal. Outside the main thread, where Python delivers no signals, the flag
    is never set.
    """

    def __init__(self) -> None:
        self._received: int | None = None
        self._previous: dict[int, object] = {}

    @property
    def is_requested(self) -> bool:
        """Whether a signal came."""
        return self._received is not None

    @property
    def received(self) -> int | None:
        """The number of the signal, None where none came."""
        return self._received

    def request(self, signal_number: int) -> None:
        """As if the signal had come here: where it came to another process of the same run."""
        if self._received is None:
            self._received = signal_number

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._on_signal) for number in SIGNALS}
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        if self._received is not None and error_type is None:
            raise Interrupted(self._received)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._received is not None:
            raise Interrupted(number)
        self._received = number

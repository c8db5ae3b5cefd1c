"""Commands from a frozen dataclass of options and a `main`: parsing, one-line errors, signals, exit codes."""

from __future__ import annotations

import logging
import math
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from types import FrameType
from typing import Any, TypeVar

from tqdm import tqdm

from dpmjax.cli import program
from dpmjax.cli.info import select_device
from dpmjax.cli.options import parse_options, without_latest
from dpmjax.cli.run_folder import OutputOptions, RunFailedError, check_run_folder, find_run, load_config
from dpmjax.compile_cache import enable_compile_cache
from dpmjax.sequences import InputError

EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT = program.EXIT_OK, 1, program.EXIT_BAD_INPUT

SIGNALS = (signal.SIGINT, signal.SIGTERM)
STOPPING = "\nstopping after the present step, results are kept; a second Ctrl-C ends at once\n"
# A signal at a moment at which nothing can be raised is sent again after this time.
_LATER_S = 0.05
ConfigT = TypeVar("ConfigT")


class Interrupted(KeyboardInterrupt):
    """A signal has stopped the run.

    Attributes:
        exit_code: exit code of a program that this signal has ended: 130 for Ctrl-C, 143 for SIGTERM.
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal.Signals(signal_number).name)
        self.exit_code = program.EXIT_BY_SIGNAL + signal_number


class StopFlag:
    """Turns the first signal into a flag; a second one interrupts at once.

        with StopFlag() as stop:
            while not stop.is_requested and step < num_steps:
                ...
            write_results()

    At the end of the block, after everything in it was written, a requested stop is raised as `Interrupted`. The
    command then ends with the exit code of the signal. Outside the main thread, where Python delivers no signals, the
    flag is never set.

    Attributes:
        received: number of the signal; None before a signal.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def is_requested(self) -> bool:
        """Returns True after a signal."""
        return self.received is not None

    @property
    def status(self) -> str:
        """Returns the status of the run for `metrics.json`."""
        return "done" if self.received is None else "interrupted"

    def end_if_requested(self) -> None:
        """Ends the block after a signal, where nothing has been made that could be written."""
        if self.received is not None:
            raise Interrupted(self.received)

    def request(self, signal_number: int) -> None:
        """Sets the flag where another process of the same run has received the signal."""
        self.received = self.received or signal_number

    def __enter__(self) -> StopFlag:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._on_signal) for number in SIGNALS}
        return self

    def __exit__(self, error_type: type[BaseException] | None, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        if self.received is not None and error_type is None:
            raise Interrupted(self.received)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise Interrupted(number)
        self.received = number
        # Written without a buffer: a handler may interrupt a print.
        os.write(2, STOPPING.encode())


def check_least(config: Any, **least: float) -> None:
    """Checks the ranges of options that are numbers, tuples of numbers, or None.

    Args:
        config: the options.
        **least: the smallest allowed value of each option.

    Raises:
        ValueError: an option is smaller, or not finite.
    """
    for name, smallest in least.items():
        values = getattr(config, name)
        for value in values if isinstance(values, tuple) else (values,):
            if value is not None and not smallest <= value < math.inf:
                raise ValueError(f"--{name.replace('_', '-')}: expected at least {smallest}, got {value}")


def check_names(option: str, names: Sequence[str], allowed: Iterable[str]) -> None:
    """Raises a ValueError where a name is not allowed, or no name is given."""
    unknown = [name for name in names if name not in allowed]
    if unknown or not names:
        raise ValueError(f"{option}: expected some of {', '.join(allowed)}, got {', '.join(unknown) or 'none'}")


def run_command(
    main: Callable[[ConfigT], object],
    config_type: type[ConfigT],
    *,
    name: str,
    description: str | None,
    args: Sequence[str] | None = None,
) -> int:
    """Parses the command line, runs `main`, and returns the exit code.

    Code 0 is success. Code 2 is wrong usage or bad input, with one line on stderr. Code 1 is a failure after partial
    results in the run folder. Codes 130 and 143 are stops by Ctrl-C or SIGTERM, with results. With `--resume`, options
    that are not given are those of the run that is resumed.

    Args:
        main: takes the options. Errors of the user are raised as `ValueError` before the run folder is opened.
        config_type: frozen dataclass. For a subclass of `OutputOptions`, the folder is checked and the device selected
            before `main`.
        name: name of the subcommand of `dpmjax`, or of the module in `experiments`; and of the folder in `results`.
        description: the module's docstring; `--help` begins with it.
        args: the command line; None takes that of the process.

    Returns:
        The exit code.
    """
    arguments = list(sys.argv[1:] if args is None else args)
    if "--version" in arguments:
        return program.main(["--version"])
    console = logging.StreamHandler()
    console.setLevel(logging.WARNING)
    logging.basicConfig(format="dpmjax: %(levelname)s: %(message)s", handlers=[console])
    previous = {number: signal.signal(number, _interrupt) for number in SIGNALS}
    previous_hook, sys.unraisablehook = sys.unraisablehook, _send_lost
    try:
        enable_compile_cache()
        config = without_latest(_parse(config_type, name, description, arguments))
        # Of several processes that run as one, `main` selects devices and one opens the folder.
        if isinstance(config, OutputOptions) and getattr(config, "coordinator", None) is None:
            check_run_folder(config, name)
            select_device(config.device)
        main(config)
    except SystemExit as done:  # after --help
        return EXIT_OK if done.code is None else int(done.code)
    except Interrupted as stop:
        return _say(f"stopped by {stop}", stop.exit_code)
    except ValueError as error:
        return _say(f"error: {error}", EXIT_BAD_INPUT)
    except PermissionError as error:
        return _say(f"error: {error.filename}: {error.strerror}", EXIT_BAD_INPUT)
    except RunFailedError as error:
        # A full disk is no fault of the program; log.txt has the traceback.
        if not isinstance(error.__cause__, InputError | OSError):
            traceback.print_exception(error.__cause__)
        return _say(f"error: {error}; what was finished is in {error.path}", EXIT_FAILED)
    except Exception as error:
        traceback.print_exception(error)
        return _say(f"error: {type(error).__name__}: {error}", EXIT_FAILED)
    finally:
        sys.unraisablehook = previous_hook
        for number, handler in previous.items():
            signal.signal(number, handler)
    return EXIT_OK


def _parse(config_type: type[ConfigT], name: str, description: str | None, arguments: list[str]) -> ConfigT:
    prog = f"dpmjax {name}" if name in program.COMMANDS else f"python -m experiments.{name}"
    parse = partial(parse_options, config_type, prog=prog, description=description)
    config = parse(arguments)
    if not getattr(config, "resume", False):
        return config
    earlier = load_config(find_run(name, getattr(config, "output", None)), config_type)
    # Of a flag that is on, tyro takes --no-FLAG alone; who repeats the command says --FLAG again.
    names = [field.name for field in fields(config_type)]  # type: ignore[arg-type]
    on = {f"--{name}".replace("_", "-") for name in names if getattr(earlier, name) is True}
    return parse([argument for argument in arguments if argument.replace("_", "-") not in on], default=earlier)


def _interrupt(number: int, frame: FrameType | None) -> None:
    # Compiled modules crash where their import is stopped.
    if any(getattr(getattr(module, "__spec__", None), "_initializing", False) for module in list(sys.modules.values())):
        _send_later(number)
    else:
        raise Interrupted(number)


def _send_lost(lost: sys.UnraisableHookArgs) -> None:
    """Sends a signal again whose `Interrupted` was lost: Python drops errors in callbacks of the garbage collector."""
    if isinstance(lost.exc_value, Interrupted):
        _send_later(lost.exc_value.exit_code - program.EXIT_BY_SIGNAL)
    else:
        sys.__unraisablehook__(lost)


def _send_later(number: int) -> None:
    timer = threading.Timer(_LATER_S, signal.raise_signal, [number])
    timer.daemon = True
    timer.start()


def _say(message: str, exit_code: int) -> int:
    print("dpmjax:", " ".join(message.split()), file=sys.stderr, flush=True)
    return exit_code


@contextmanager
def progress_bar(description: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Shows a bar while the block runs.

    Args:
        description: shown before the bar.
        unit: unit of the numbers, with a space before it.

    Yields:
        A callback with the number of finished items and the number of all.
    """
    with tqdm(desc=description, unit=unit, dynamic_ncols=True) as bar:

        def on_progress(num_done: int, num_all: int) -> None:
            bar.total = num_all
            bar.update(num_done - bar.n)

        yield on_progress

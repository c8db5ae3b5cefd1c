"""From a frozen dataclass of options and a `main` to a command: parsing, one-line errors, exit codes."""

from __future__ import annotations

import logging
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from types import FrameType
from typing import TypeVar

import tyro

from experiments._machine import enable_compilation_cache
from experiments._run_folder import RunFailedError, find_run, load_config
from experiments._stop import Interrupted

EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT = 0, 1, 2

ConfigT = TypeVar("ConfigT")


def run_command(
    main: Callable[[ConfigT], object],
    config_type: type[ConfigT],
    *,
    experiment: str,
    description: str | None,
    args: Sequence[str] | None = None,
) -> int:
    """Parses the command line, runs `main`, and returns the exit code.

    0: done. 2: wrong usage or bad input, told in one line on stderr. 1: failed on the way; what was finished is in the
    run folder. 130, 143: stopped by Ctrl-C or SIGTERM, results written. With `--resume`, options that are not given are
    those of the run that is resumed.

    Args:
        main: takes the options. Errors of the user are raised as `ValueError` before the run folder is opened.
        config_type: frozen dataclass; the fields `output` and `resume`, where it has them, steer `--resume`.
        experiment: name of the module in `experiments` and of the folder in `results`.
        description: the module's docstring; `--help` begins with it.
        args: the command line; None takes that of the process.
    """
    arguments = list(sys.argv[1:] if args is None else args)
    if "--version" in arguments:
        import dpmjax

        print(f"dpmjax {dpmjax.__version__}")
        return EXIT_OK
    console = logging.StreamHandler()
    console.setLevel(logging.WARNING)
    logging.basicConfig(format="dpmjax: %(levelname)s: %(message)s", handlers=[console])
    previous = signal.signal(signal.SIGTERM, _interrupt)
    enable_compilation_cache()
    try:
        main(_parse(config_type, experiment, description, arguments))
    except SystemExit as done:  # tyro, after --help or wrong usage
        return EXIT_OK if done.code is None else int(done.code)
    except Interrupted as stop:
        return _say(f"stopped by {stop}", stop.exit_code)
    except KeyboardInterrupt:
        return _say("stopped by SIGINT", 128 + signal.SIGINT)
    except ValueError as error:
        return _say(f"error: {error}", EXIT_BAD_INPUT)
    except RunFailedError as error:
        traceback.print_exception(error.__cause__)
        return _say(f"error: {error}; what was finished is in {error.path}", EXIT_FAILED)
    except Exception as error:
        traceback.print_exception(error)
        return _say(f"error: {type(error).__name__}: {error}", EXIT_FAILED)
    finally:
        signal.signal(signal.SIGTERM, previous)
    return EXIT_OK


def _parse(config_type: type[ConfigT], experiment: str, description: str | None, arguments: list[str]) -> ConfigT:
    prog = f"python -m experiments.{experiment}"
    config = tyro.cli(config_type, prog=prog, description=description, args=arguments)
    if not getattr(config, "resume", False):
        return config
    stored = load_config(find_run(experiment, getattr(config, "output", None)), config_type)
    return tyro.cli(config_type, prog=prog, description=description, args=arguments, default=stored)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def _say(message: str, exit_code: int) -> int:
    print("dpmjax:", " ".join(message.split()), file=sys.stderr, flush=True)
    return exit_code

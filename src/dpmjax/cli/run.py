"""One run of a command: options, folder, log, Ctrl-C, numbers, exit code.

A command is a frozen dataclass of options and a function of them:

    def main(options: ToyOptions, run: Run) -> Numbers:
        scans = io.read_sequence(options.data)      # bad input: one line, exit code 2, no folder
        run.open(scans.notes)                       # from here on, results are kept and Ctrl-C ends the next step
        ...
        return {"ate_m": 0.1, "verdict": "trusted: ..."}

Everything else happens here: `metrics.json` gets the numbers, the console the verdict, the shell the exit code.
"""

from __future__ import annotations

import csv
import dataclasses
import inspect
import itertools
import json
import logging
import math
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

import numpy as np

from dpmjax import io
from dpmjax.cli import program
from dpmjax.cli.info import environment
from dpmjax.cli.options import parse_options
from dpmjax.cli.report import write_report
from dpmjax.compile_cache import enable_compile_cache
from dpmjax.sequences import InputError, Note

EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT = program.EXIT_OK, 1, program.EXIT_BAD_INPUT
CONFIG, METRICS, HISTORY, LOG, CHECKPOINTS = "config.json", "metrics.json", "metrics.csv", "log.txt", "checkpoints"
STOPPING = "\nstopping after the present step, results are kept; a second Ctrl-C ends at once\n"
RESULTS, LOGGER = Path("results"), logging.getLogger("dpmjax")
# Options that do not change the result.
FREE_OPTIONS = frozenset({"output", "resume", "force", "coordinator", "num_processes", "process_id", "visualize"})

Numbers = dict[str, Any]


class Interrupted(KeyboardInterrupt):
    """A signal has stopped the run."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = program.EXIT_BY_SIGNAL + number


class Run:
    """The folder of one run, and its stop by signals.

    Attributes:
        path: the folder; it exists after `open`.
        is_resumed: True if an earlier run is continued.
    """

    def __init__(self, name: str, options: Any) -> None:
        """Finds the folder, and refuses it before any work.

        Args:
            name: name of the command, and of its folder in `results`.
            options: `OutputOptions` or `RunOptions`, or those of a command without results.

        Raises:
            ValueError: OUT holds something, and neither --resume nor --force is given; there is nothing to resume; the
                resumed run had other options; or --force would remove an input.
        """
        self._options, self._started = options, time.perf_counter()
        self._handler: logging.Handler | None = None
        self._stops: list[BaseException] = []
        self._notes: list[str] = []
        self.is_resumed = getattr(options, "resume", False)
        output = getattr(options, "output", None)
        self.path = Path(output or RESULTS / name / datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
        if self.is_resumed:
            self.path = find_run(name, output)
            check_same_options(self.path, options)
        elif output is not None:
            check_replaceable(self.path, options)

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    @property
    def is_open(self) -> bool:
        """Returns True after `open`."""
        return self._handler is not None

    @property
    def is_stopped(self) -> bool:
        """Returns True after the first signal or failure: the run writes its results and ends."""
        return bool(self._stops)

    def check_stop(self) -> None:
        """Ends the run after a signal, in the middle of work whose results cannot be kept."""
        if self._stops:
            raise self._stops[0]

    def fail(self, error: Exception) -> None:
        """Stops the run as a signal does: the run writes its results before the error ends the command."""
        self._stops.append(error)

    def open(self, notes: Iterable[Note] = ()) -> None:
        """Makes the folder, or empties it with --force, and writes `config.json`; call it after the input was read.

        Args:
            notes: doubts and decisions on the input.

        Raises:
            ValueError: the folder cannot be written.
        """
        options = self._options
        try:
            if options.output is None and not self.is_resumed:
                self.path = make_latest(self.path)
            self.path.mkdir(parents=True, exist_ok=True)
            for entry in self.path.iterdir() if options.force else ():
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            write_json(self / CONFIG, options)
            self._handler = logging.FileHandler(self / LOG, encoding="utf-8")
        except OSError as error:
            reason = error.strerror or str(error)
            raise ValueError(f"cannot write to {self.path}: {reason}; name another folder with -o") from error
        self._handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        LOGGER.addHandler(self._handler)
        LOGGER.setLevel(logging.INFO)
        self.note(notes)

    def note(self, notes: Iterable[Note]) -> None:
        """Logs doubts and decisions on the input, and keeps them for `metrics.json`."""
        for note in notes:
            self._notes.append(note.text)
            LOGGER.info("%s", note.text)
            if not note.is_doubt:  # the reader has warned of a doubt
                print(note.text, flush=True)

    def close(self) -> None:
        """Ends the log."""
        if self._handler is not None:
            LOGGER.removeHandler(self._handler)
            self._handler.close()
            self._handler = None

    def say(self, text: str) -> None:
        """Prints a text, and writes it to the log."""
        print(text, flush=True)
        LOGGER.info("%s", text)

    def write_numbers(self, numbers: Mapping[str, Any]) -> None:
        """Writes `metrics.json`: status and verdict, the numbers, then notes, seed, versions, device and machine."""
        status = "interrupted" if self.is_stopped else numbers.get("status", "done")
        seed = {"seed": self._options.seed} if hasattr(self._options, "seed") else {}
        after = {"input_notes": self._notes, "wall_s": time.perf_counter() - self._started, **seed, **environment()}
        write_json(self / METRICS, {**numbers, "status": status, **after})

    def read_table(self, name: str) -> list[dict[str, str]]:
        """Reads the rows of a table, without a last line that a crash has cut off; none if there is no table."""
        path = self / name
        text = path.read_text(encoding="utf-8", errors="surrogateescape") if path.exists() else ""
        return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))

    def continue_table(self, name: str, until: float = math.inf) -> list[dict[str, str]]:
        """Keeps the rows whose first column is at most `until`; later ones will be computed again.

        Args:
            name: name of the file.
            until: largest first column, a count of steps.

        Returns:
            The rows.
        """
        rows = [row for row in self.read_table(name) if until == math.inf or int(next(iter(row.values()))) <= until]
        (self / name).unlink(missing_ok=True) if not rows else write_table(self / name, list(rows[0]), rows)
        return rows

    def append_row(self, name: str, **row: object) -> None:
        """Adds a row to a table. The first row defines the columns; a missing column stays empty."""
        path = self / name
        is_new = not path.exists()
        with path.open("a+", newline="", encoding="utf-8", errors="surrogateescape") as file:
            file.seek(0)
            columns = list(row) if is_new else next(csv.reader(file))
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)

    def on_signal(self, number: int, _frame: object = None) -> None:
        """Stops the run at its next step; without a folder, or at a second signal, at once."""
        if self.is_stopped or not self.is_open:
            raise Interrupted(number)
        self._stops.append(Interrupted(number))
        os.write(2, STOPPING.encode())  # without a buffer: a handler may interrupt a print


def run_command(
    main: Callable[[Any, Run], Numbers], *, name: str, description: str | None, args: Sequence[str] | None = None
) -> int:
    """Parses the command line, runs `main`, writes its numbers, and returns the exit code.

    Code 0 is success. Code 2 is wrong usage or bad input, with one line on stderr. Code 1 is a failure after the folder
    was opened, or numbers with the status "failed". Codes 130 and 143 are stops by Ctrl-C or SIGTERM, with results.

    Args:
        main: takes the options and the run. Its annotation names the frozen dataclass of the options. It returns the
            numbers of `metrics.json`, with `verdict`, one sentence, and with `status` if that is not "done".
        name: name of the subcommand of `dpmjax` or of the module in `experiments`, and of the folder in `results`.
        description: the module's docstring; `--help` begins with it.
        args: the command line; None takes that of the process.

    Returns:
        The exit code.
    """
    console = logging.StreamHandler()
    console.setLevel(logging.WARNING)
    logging.basicConfig(format="dpmjax: %(levelname)s: %(message)s", handlers=[console])
    run: Run | None = None
    previous = {number: signal.signal(number, _end_at_once) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        enable_compile_cache()
        options = _read_options(main, name, description, list(sys.argv[1:] if args is None else args))
        run = Run(name, options)
        for number in previous:
            signal.signal(number, run.on_signal)
        return _finish(run, main(options, run))
    except SystemExit as done:  # after --help
        return int(done.code or 0)
    except Interrupted as stop:
        return _say(f"stopped by {stop}", stop.exit_code)
    except Exception as error:
        return _explain(error, run)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if run is not None:
            run.close()


def run_experiment(main: Callable[[Any, Run], Numbers]) -> NoReturn:
    """Runs the `main` of a module of `experiments`, and ends the process."""
    description = sys.modules[main.__module__].__doc__
    program.end_process(run_command(main, name=Path(inspect.getfile(main)).stem, description=description))


def _finish(run: Run, numbers: Numbers) -> int:
    """Writes the numbers, and prints the verdict and the folder of the results."""
    if run.is_open:
        run.write_numbers(numbers)
    has_failed = numbers.get("status") == "failed" and not run.is_stopped
    if "verdict" in numbers and not has_failed:
        run.say(numbers["verdict"])
    if run.is_open:
        write_report(run.path, run.read_table)
        print(f"results in {run.path}", flush=True)
    run.check_stop()
    return _say(f"error: {numbers['verdict']}; results are in {run.path}", EXIT_FAILED) if has_failed else EXIT_OK


def _explain(error: Exception, run: Run | None) -> int:
    """Prints the error in one line, after the traceback if the program is at fault."""
    is_open, text = run is not None and run.is_open, str(error).removesuffix(".")
    is_usual = isinstance(error, InputError | OSError if is_open else ValueError | PermissionError)
    if not isinstance(error, InputError) and (is_open or not is_usual):
        text = f"{type(error).__name__}: {error}"
    elif isinstance(error, PermissionError):
        text = f"{error.filename}: {error.strerror}"
    if run is not None and is_open:
        LOGGER.info("failed", exc_info=error)
        text += f"; what was finished is in {run.path}"
    if not is_usual:
        traceback.print_exception(error)
    return _say(f"error: {text}", EXIT_BAD_INPUT if is_usual and not is_open else EXIT_FAILED)


def _end_at_once(number: int, _frame: object) -> NoReturn:
    raise Interrupted(number)


def _say(message: str, exit_code: int) -> int:
    print("dpmjax:", " ".join(message.split()), file=sys.stderr, flush=True)
    return exit_code


def _read_options(main: Callable[..., Numbers], name: str, description: str | None, arguments: list[str]) -> Any:
    """Returns the options of the command line, with those of the earlier run if it is resumed."""
    options_type = get_type_hints(main)["options"]
    prog = f"dpmjax {name}" if name in program.COMMANDS else f"python -m experiments.{name}"
    options = parse_options(options_type, arguments, prog=prog, description=description)
    if getattr(options, "resume", False):
        earlier = load_options(find_run(name, options.output), options_type)
        # Of a flag that is on, tyro takes --no-FLAG alone; who repeats the command says --FLAG again.
        on = {f"--{field.name}" for field in dataclasses.fields(earlier) if getattr(earlier, field.name) is True}
        again = [word for word in arguments if word.replace("-", "_").replace("__", "--", 1) not in on]
        options = parse_options(options_type, again, prog=prog, default=earlier)
    paths = {field.name: _without_latest(getattr(options, field.name)) for field in dataclasses.fields(options)}
    return dataclasses.replace(options, **{name: value for name, value in paths.items() if name != "output"})


def _without_latest(value: Any) -> Any:
    # The next run moves the link `latest`, and a resumed one must find the same file.
    if isinstance(value, tuple):
        return tuple(map(_without_latest, value))
    is_link = isinstance(value, str | Path) and "latest" in Path(value).parts and Path(value).exists()
    return type(value)(Path(value).resolve()) if is_link else value


def load_options(path: Path, options_type: Any) -> Any:
    """Reads the options of an earlier run; missing options, and those such as `output`, get their defaults.

    Args:
        path: folder of the run.
        options_type: dataclass of the options.

    Returns:
        The options.

    Raises:
        ValueError: its `config.json` is no JSON, or has an option that `options_type` lacks.
    """
    from dpmjax.weights.config_json import config_from_json

    stored = {name: value for name, value in load_json(path / CONFIG).items() if name not in FREE_OPTIONS}
    try:
        return config_from_json(stored, options_type)
    except ValueError as error:
        raise ValueError(f"{path / CONFIG} holds options of another command or version: {error}") from error


def find_run(name: str, output: Path | None) -> Path:
    """Finds the folder of an earlier run.

    Args:
        name: name of the command.
        output: the folder, or None for the latest run of this command.

    Returns:
        The folder.

    Raises:
        ValueError: there is none.
    """
    path = output or RESULTS / name / "latest"
    if not (path / CONFIG).is_file():
        raise ValueError(f"{path} holds no {CONFIG}: it is no run of {name}; name one (--resume -o OUT)")
    return path if output else path.resolve()


def check_same_options(path: Path, options: Any) -> None:
    """Raises a ValueError if a resumed run would have other options than the earlier one."""
    if options.force:
        raise ValueError("--resume continues a run and --force starts it over: give one of them")
    stored, now = load_json(path / CONFIG), as_json(options)
    for name in sorted(stored.keys() & now.keys() - FREE_OPTIONS - options.may_change):
        if stored[name] != now[name]:
            was, is_now = ("not given" if value is None else value for value in (stored[name], now[name]))
            raise ValueError(
                f"--{name.replace('_', '-')} was {was} in {path} and is {is_now} now: a resumed run keeps its options; "
                "start a new run for others"
            )


def check_replaceable(path: Path, options: Any) -> None:
    """Raises a ValueError for a folder that is not writable or not empty, or that --force must not remove."""
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        reason = "permission denied" if existing.is_dir() else f"{existing} is a file"
        raise ValueError(f"cannot write to {path}: {reason}; name another folder with -o")
    if existing != path or not any(path.iterdir()):
        return
    if not (path / CONFIG).is_file() or "output" not in load_json(path / CONFIG):
        raise ValueError(f"{path} is not empty and holds no earlier run: name another folder with -o")
    if not options.force:
        resume = "--resume continues it, " if hasattr(options, "resume") else ""
        raise ValueError(f"{path} holds an earlier run: {resume}--force replaces it, -o names another")
    values = [
        value if isinstance(value, tuple) else (value,) for name, value in vars(options).items() if name != "output"
    ]
    for value in itertools.chain(*values):
        is_inside = isinstance(value, str | Path) and Path(value).resolve().is_relative_to(path.resolve())
        if is_inside and str(value) and Path(value).exists():
            raise ValueError(f"--force would remove {value}, an input: name another folder with -o")


def make_latest(path: Path) -> Path:
    """Makes a new folder, and points the link `latest` beside it there."""
    while path.exists():  # a second run of the same second
        path = path.with_name(f"{path.name}_2")
    path.mkdir(parents=True)
    link = path.parent / f".latest_{path.name}"
    link.symlink_to(path.name, target_is_directory=True)
    link.replace(path.parent / "latest")
    return path


def write_json(path: Path, value: Any) -> None:
    """Writes dataclasses, paths and NumPy values as JSON, atomically; NaN and infinity become null."""
    io.write_atomically(path, json.dumps(as_json(value), indent=2) + "\n")


def as_json(value: Any) -> Any:
    """Returns the same value made of JSON's types; NaN and infinity become None."""

    def plain(one: Any) -> Any:
        if dataclasses.is_dataclass(one) and not isinstance(one, type):
            return dataclasses.asdict(one)
        return np.asarray(one).tolist() if hasattr(one, "__array__") else str(one)

    return json.loads(json.dumps(value, default=plain), parse_constant=lambda _: None)


def load_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object; a file that holds something else is a ValueError."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a JSON object: {error}") from error


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes these columns as CSV, atomically: numbers with six digits, truth values as 0 and 1, None as empty."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        cells = (row[column] for column in columns)
        writer.writerow([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in cells])
    io.write_atomically(path, text.getvalue())


def write_poses(folder: Path, poses: np.ndarray, name: str = "trajectory", **tum: Any) -> None:
    """Writes poses in the plane or in space as NAME.npy, NAME_tum.txt and NAME_kitti.txt.

    Args:
        folder: folder of the files.
        poses: poses of all scans.
        name: beginning of the names of the files.
        **tum: options of `io.write_tum`, such as the times.
    """
    io.write_poses_npy(folder / f"{name}.npy", poses)
    io.write_tum(folder / f"{name}_tum.txt", poses, **tum)
    io.write_kitti(folder / f"{name}_kitti.txt", poses)

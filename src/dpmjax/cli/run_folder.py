"""The folder of one run: options of every command, rules for overwriting, and the log."""

from __future__ import annotations

import itertools
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from tyro.conf import FlagCreatePairsOff, arg

from dpmjax.cli.info import environment
from dpmjax.cli.result_files import as_json, commits_note, load_json, write_json
from dpmjax.sequences import InputError

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

CONFIG, METRICS, HISTORY, LOG = "config.json", "metrics.json", "metrics.csv", "log.txt"
CHECKPOINTS, BEST, AGENTS, DRIVES = "checkpoints", "checkpoints_best", "agents", "drives"
# --force removes these folders and kinds of files only, so that a mistyped -o removes no other files.
RESULT_FOLDERS = (CHECKPOINTS, BEST, AGENTS, DRIVES, "rows")
RESULT_SUFFIXES = (".json", ".csv", ".txt", ".npy", ".npz", ".png", ".ply", ".g2o", ".rrd")
LOGGERS = ("dpmjax", "experiments", "__main__")
# Options that do not change the result.
FREE_OPTIONS = frozenset(
    {"output", "resume", "force", "device", "coordinator", "num_processes", "process_id", "visualize"}
)
RESULTS = Path("results")
# Handles of the folders that this process has locked.
_LOCKS: dict[Path, int] = {}

ConfigT = TypeVar("ConfigT")


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Options of every command that writes results."""

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT")] = None
    """Folder for the results, instead of results/<command>/<time>."""
    force: FlagCreatePairsOff[bool] = False
    """Replace an earlier run in OUT."""
    device: Annotated[Literal["cpu", "gpu"] | None, arg(metavar="cpu|gpu")] = None
    """Where to compute; without it, JAX chooses."""


@dataclass(frozen=True, kw_only=True)
class ScanOptions:
    """Options of every command that reads scans or images in a row."""

    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Use the first N scans, after --jump; without it, all."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan."""

    @property
    def selection(self) -> slice:
        """Returns the rows of the scans to use."""
        return slice(None, None if self.n_scans is None else self.n_scans * self.jump, self.jump)


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Options of every command that uses trained weights."""

    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file; a saved map needs the weights that made it."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(OutputOptions):
    """Options of every command that can be interrupted and resumed.

    Attributes:
        may_change: options that a resumed run may change, besides those that do not affect the computation.
    """

    may_change: ClassVar[frozenset[str]] = frozenset()

    seed: int = 0
    """Seed of everything random."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue an interrupted run, the latest or that in OUT; options not given are the same as then."""


class RunFailedError(RuntimeError):
    """A run failed after its folder was made; `path` has the files so far, and its log has the traceback."""

    def __init__(self, path: Path, error: Exception) -> None:
        is_input = isinstance(error, InputError)
        super().__init__(str(error).removesuffix(".") if is_input else f"{type(error).__name__}: {error}")
        self.path = path


@dataclass(frozen=True)
class RunFolder:
    """An open run folder.

    Attributes:
        path: the folder; it exists.
        is_resumed: True where an earlier run is continued.
    """

    path: Path
    is_resumed: bool

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def part(self, kind: Literal["agents", "drives", "methods"], name: str) -> RunFolder:
        """Makes the folder of one agent, drive or method, or continues an earlier run in it."""
        path = self.path / kind / name
        path.mkdir(parents=True, exist_ok=True)
        return RunFolder(path, is_resumed=True)


def open_run_folder(config: Any, experiment: str) -> RunFolder:
    """Makes the folder of a run, or finds the one to continue, and writes `config.json`.

    Call it after the input was read, so that bad input leaves no folder behind.

    Args:
        config: the resolved options, a dataclass such as `RunOptions`. Its `output` None makes
            `results/<experiment>/<timestamp>` and lets `latest` beside it point there; `resume` continues the run in
            `output`, or the latest one; `force` empties `output` first where it holds an earlier run.
        experiment: name of the experiment.

    Returns:
        The open folder.

    Raises:
        ValueError: as `check_run_folder`; or the folder cannot be made, or another process is writing in it.
    """
    check_run_folder(config, experiment)
    is_resumed = getattr(config, "resume", False)
    try:
        if is_resumed:
            path = find_run(experiment, config.output)
        elif config.output is None:
            path = _make_timestamped(RESULTS / experiment)
        else:
            path = config.output
            path.mkdir(parents=True, exist_ok=True)
        _lock(path)
        if config.output is not None and not is_resumed:
            _clear(path)
        write_json(path / CONFIG, config)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(_cannot_write(config.output or RESULTS / experiment, reason)) from error
    return RunFolder(path, is_resumed=is_resumed)


def _lock(path: Path) -> None:
    """Keeps other processes out of a folder, where the system can lock folders; `recording` ends it."""
    if fcntl is None or path.resolve() in _LOCKS:
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise ValueError(f"{path}: another process is writing this run; let it end, or stop it") from error
    except OSError:
        pass  # a network file system without locks
    _LOCKS[path.resolve()] = handle


def check_run_folder(config: Any, experiment: str) -> None:
    """Raises the errors of `open_run_folder` before any work, without changes on disk.

    Args:
        config: the resolved options.
        experiment: name of the experiment.

    Raises:
        ValueError: `output` is not empty, and neither `resume` nor `force` is given. Also if there is nothing to
            resume, if the resumed run had other options, if the folder cannot be written, or if `force` would remove
            an input.
    """
    if getattr(config, "resume", False):
        if config.force:
            raise ValueError("--resume continues a run and --force starts it over: give one of them")
        _check_same_options(config, find_run(experiment, config.output))
    elif config.output is not None:
        _check_replaceable(config)
        _check_inputs_stay(config)


def find_run(experiment: str, output: Path | None) -> Path:
    """Finds the folder of an earlier run.

    Args:
        experiment: name of the experiment.
        output: the folder, or None for the latest run of this experiment.

    Returns:
        The folder.

    Raises:
        ValueError: there is none.
    """
    path = output or RESULTS / experiment / "latest"
    if not (path / CONFIG).is_file():
        raise ValueError(f"{path} holds no {CONFIG}: it is no run of {experiment}; name one (--resume -o OUT)")
    return path if output else path.resolve()


def load_config(path: Path, config_type: type[ConfigT]) -> ConfigT:
    """Reads the options of an earlier run; missing options, and those such as `output`, get their defaults.

    Args:
        path: folder of the run.
        config_type: dataclass of the options.

    Returns:
        The options.

    Raises:
        ValueError: its `config.json` holds an option that `config_type` does not have, or is no JSON.
    """
    from dpmjax.weights.config_json import config_from_json

    stored = {name: value for name, value in load_json(path / CONFIG).items() if name not in FREE_OPTIONS}
    try:
        return config_from_json(stored, config_type)
    except ValueError as error:
        raise ValueError(f"{path / CONFIG} holds options of another command or version: {error}") from error


def write_metrics(
    folder: RunFolder,
    metrics: Mapping[str, Any],
    *,
    seed: int | None = None,
    rows: Sequence[Mapping[str, Any]] | None = None,
    table: Sequence[Mapping[str, Any]] | None = None,
) -> str | None:
    """Writes `metrics.json`: status, plain names with units, then the seed, the versions, the device and the machine.

    Args:
        folder: folder of the run.
        metrics: numbers by name; without a `status` among them, it is "done".
        seed: seed of the run; None where nothing is random.
        rows: rows made by `do_row`; the file names those of another commit than its own.
        table: rows of the file; None: those of `do_row`.

    Returns:
        The note about such rows, or None where all rows are of this commit.
    """
    made_by = environment()
    note = commits_note(rows or (), made_by["git_hash"])
    noted_rows = {} if rows is None else {"note": note, "rows": rows if table is None else table}
    seeds = {} if seed is None else {"seed": seed}
    write_json(folder / METRICS, {"status": "done", **metrics, **seeds, **made_by, **noted_rows})
    return note


@contextmanager
def recording(folder: RunFolder) -> Iterator[None]:
    """Logs the messages of the block to `log.txt`, and the traceback if it fails.

    Args:
        folder: folder of the run.

    Yields:
        Nothing.

    Raises:
        RunFailedError: from the error that ended the block.
        KeyboardInterrupt: the block was interrupted.
    """
    handler = logging.FileHandler(folder / LOG, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    loggers = [logging.getLogger(name) for name in LOGGERS]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
    try:
        yield
    except KeyboardInterrupt as stop:
        loggers[-1].info("stopped by %s", stop or "SIGINT")
        raise
    except Exception as error:
        # The console shows the error too, and only warnings and errors.
        loggers[-1].info("failed", exc_info=error)
        raise RunFailedError(folder.path, error) from error
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.removeHandler(handler)
            logger.setLevel(level)
        handler.close()
        if folder.path.resolve() in _LOCKS:
            os.close(_LOCKS.pop(folder.path.resolve()))


def tell(text: str) -> None:
    """Prints a text, and writes it to the log of the run."""
    print(text, flush=True)
    logging.getLogger("dpmjax").info("%s", text)


def _check_same_options(config: Any, path: Path) -> None:
    stored, now = load_json(path / CONFIG), as_json(config)
    for name in sorted(stored.keys() & now.keys() - FREE_OPTIONS - getattr(config, "may_change", frozenset())):
        if stored[name] != now[name]:
            raise ValueError(
                f"--{name.replace('_', '-')} was {_said(stored[name])} in {path} and is {_said(now[name])} now: "
                "a resumed run keeps its options; start a new run for others"
            )


def _said(value: Any) -> Any:
    """Returns the value of an option for a message."""
    return "not given" if value is None else value


def _make_timestamped(parent: Path) -> Path:
    parent.mkdir(parents=True, exist_ok=True)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for number in itertools.count(1):
        path = parent / (stamp if number == 1 else f"{stamp}_{number}")
        with suppress(FileExistsError):
            path.mkdir()
            break
    link, unfinished = parent / "latest", parent / f".latest_{path.name}"
    try:
        unfinished.symlink_to(path.name, target_is_directory=True)
        os.replace(unfinished, link)
    except OSError as error:  # a file system without links
        logging.getLogger(__name__).warning("cannot link %s to the newest run: %s", link, error)
    return path


def _check_replaceable(config: Any) -> None:
    """Raises a ValueError where `output` is no folder, cannot be written, or has files that must not be replaced."""
    path = config.output
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not existing.is_dir():
        raise ValueError(_cannot_write(path, f"{existing} is a file"))
    if not os.access(existing, os.W_OK):
        raise ValueError(_cannot_write(path, "permission denied"))
    # A run that was killed while it wrote its configuration leaves the temporary file of that.
    if existing != path or all(entry.name.startswith(f".{CONFIG}.") for entry in path.iterdir()):
        return
    if not (path / CONFIG).is_file():
        raise ValueError(f"{path} is not empty and holds no earlier run: name another folder with -o")
    if not config.force:
        resume = "--resume continues it, " if hasattr(config, "resume") else ""
        raise ValueError(f"{path} holds an earlier run: {resume}--force replaces it, -o names another")


def _cannot_write(path: Path, reason: str) -> str:
    """Returns the message of a folder that cannot be written."""
    return f"cannot write to {path}: {reason}; name another folder with -o"


def _check_inputs_stay(config: Any) -> None:
    """Raises a ValueError where an option names the folder of results, or a file in it that `_clear` removes."""
    removed = [entry.resolve() for entry in _results_in(config.output)]
    options = (option if isinstance(option, tuple) else (option,) for option in vars(config).values())
    for value in itertools.chain(*options):
        if value is config.output or not isinstance(value, str | Path):
            continue
        path = Path(value).resolve()
        # A text may be a name, such as that of weights.
        is_folder = isinstance(value, Path) and path == config.output.resolve()
        if removed and (is_folder or any(path.is_relative_to(entry) for entry in removed)):
            raise ValueError(f"--force would remove files of {value}, an input: name another folder with -o")


def _clear(path: Path) -> None:
    """Removes the results of an earlier run."""
    for entry in _results_in(path):
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _results_in(path: Path) -> list[Path]:
    """Returns the folders and files of an earlier run that a new one replaces; none where there is no folder."""
    entries = path.iterdir() if path.is_dir() else ()
    return [
        entry
        for entry in entries
        if (entry.name in RESULT_FOLDERS and entry.is_dir()) or (entry.suffix in RESULT_SUFFIXES and entry.is_file())
    ]

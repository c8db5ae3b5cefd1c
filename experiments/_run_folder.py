"""The folder of one run: where it lies, what may be overwritten, and files that appear whole or not at all."""

from __future__ import annotations

import csv
import dataclasses
import json
import logging
import math
import os
import shutil
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np

from experiments._machine import environment

CONFIG, METRICS, HISTORY, LOG = "config.json", "metrics.json", "metrics.csv", "log.txt"
CHECKPOINTS = "checkpoints"
# --force removes these kinds of files only: a mistyped -o must not cost a user anything else.
RESULT_SUFFIXES = (".json", ".csv", ".txt", ".npy", ".npz", ".png", ".ply", ".g2o")
LOGGERS = ("dpmjax", "experiments", "__main__")
# Options that do not change what is computed.
FREE_OPTIONS = frozenset({"output", "resume", "force", "device"})

ConfigT = TypeVar("ConfigT")


class RunFailedError(RuntimeError):
    """A run broke off after its folder was made; what it had written is in `path`, the traceback in its log."""

    def __init__(self, path: Path, error: Exception) -> None:
        super().__init__(f"{type(error).__name__}: {error}")
        self.path = path


@dataclass(frozen=True)
class RunFolder:
    """An open run folder.

    Attributes:
        path: the folder; it exists.
        is_resumed: an earlier run is continued in it.
    """

    path: Path
    is_resumed: bool

    def __truediv__(self, name: str) -> Path:
        return self.path / name


def open_run_folder(
    config: Any,
    experiment: str,
    *,
    output: Path | None,
    resume: bool = False,
    force: bool = False,
    root: Path = Path("results"),
    may_change: frozenset[str] = frozenset(),
) -> RunFolder:
    """Makes the folder of a run, or finds the one to continue, and writes `config.json`.

    Call it after the input was read, so that bad input leaves no folder behind.

    Args:
        config: the resolved options, a dataclass.
        experiment: name of the experiment.
        output: the folder; None makes `root/<experiment>/<timestamp>` and lets `latest` beside it point there.
        resume: continue the run in `output`, or the latest one.
        force: empty `output` first where it holds an earlier run.
        root: folder of all results.
        may_change: options that a resumed run may change, besides those that do not change what is computed.

    Raises:
        ValueError: `output` holds something and neither `resume` nor `force` is given; there is nothing to resume; the
            resumed run had other options; the folder cannot be made.
    """
    if resume and force:
        raise ValueError("--resume continues a run and --force starts it over: give one of them")
    try:
        if resume:
            path = find_run(experiment, output, root)
            _check_same_options(load_json(path / CONFIG), as_json(config), path, FREE_OPTIONS | may_change)
        elif output is None:
            path = _make_timestamped(root / experiment)
        else:
            path = output
            _make_empty(path, force)
        write_json(path / CONFIG, config)
    except OSError as error:
        where = output if output is not None else root / experiment
        raise ValueError(f"cannot write to {where}: {error.strerror or error}; name another folder with -o") from error
    return RunFolder(path, is_resumed=resume)


def find_run(experiment: str, output: Path | None, root: Path = Path("results")) -> Path:
    """The folder of an earlier run: `output`, or the latest of this experiment.

    Raises:
        ValueError: there is none.
    """
    path = output if output is not None else root / experiment / "latest"
    if not (path / CONFIG).is_file():
        raise ValueError(f"nothing to resume: {path} holds no {CONFIG}; name the folder of a run with -o")
    return path.resolve() if output is None else path


def load_config(path: Path, config_type: type[ConfigT]) -> ConfigT:
    """Reads back the options that `config.json` holds; those that it lacks, and the free ones, get their defaults.

    Raises:
        ValueError: it holds an option that `config_type` does not have, or is no JSON.
    """
    stored = load_json(path)
    hints = typing.get_type_hints(config_type)
    unknown = sorted(set(stored) - set(hints))
    if unknown:
        raise ValueError(f"{path} holds options that this version does not know: {', '.join(unknown)}")
    kept = {name: value for name, value in stored.items() if name not in FREE_OPTIONS}
    return config_type(**{name: _from_json(value, hints[name]) for name, value in kept.items()})


def write_metrics(folder: RunFolder, metrics: Mapping[str, Any], *, seed: int) -> None:
    """Writes `metrics.json`: plain names with units, then the seed, the versions, the device and the machine."""
    write_json(folder / METRICS, {**metrics, "seed": seed, **environment()})


@contextmanager
def recording(folder: RunFolder) -> Iterator[None]:
    """Logs to `log.txt` what happens in the block, and the traceback if it fails.

    Raises:
        RunFailedError: from the error that ended the block. Interrupts pass through.
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
        # The console tells it too: here only the file must not miss it.
        handler.handle(logging.LogRecord("dpmjax", logging.ERROR, __file__, 0, "failed", (), _exc_info(error)))
        raise RunFailedError(folder.path, error) from error
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.removeHandler(handler)
            logger.setLevel(level)
        handler.close()


class HistoryFile:
    """`metrics.csv`, one row a record, each on disk as soon as it is known.

    Args:
        folder: the run.
        columns: names of the columns, the first counts steps.
        keep_until: in a resumed run, rows with a larger first column are dropped; they will be computed again.
    """

    def __init__(self, folder: RunFolder, columns: Sequence[str], *, keep_until: int | None = None) -> None:
        path = folder / HISTORY
        kept: list[dict[str, str]] = []
        if keep_until is not None and path.exists():
            kept = [row for row in read_history(path) if int(row[columns[0]]) <= keep_until]
        unfinished = path.with_name(f".{path.name}.tmp")
        with unfinished.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(kept)
        os.replace(unfinished, path)
        self._file = path.open("a", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, columns, lineterminator="\n")

    def append(self, **row: object) -> None:
        """Adds a row; a column that is not given stays empty."""
        self._writer.writerow(row)
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()


def read_history(path: Path) -> list[dict[str, str]]:
    """Rows of a `metrics.csv`; a last line that was cut off by a crash is left out."""
    text = path.read_text(encoding="utf-8")
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))


def write_json(path: Path, value: Any) -> None:
    """Writes dataclasses, paths, NumPy values as JSON; the file appears whole or not at all."""
    text = json.dumps(as_json(value), indent=2, allow_nan=False) + "\n"
    unfinished = path.with_name(f".{path.name}.tmp")
    unfinished.write_text(text, encoding="utf-8")
    os.replace(unfinished, path)


def load_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        ValueError: it is no JSON object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def as_json(value: Any) -> Any:
    """The same value out of JSON's types. What JSON cannot say, NaN and infinity, becomes null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): as_json(entry) for name, entry in value.items()}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic) or hasattr(value, "__array__"):
        return as_json(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _from_json(value: Any, hint: Any) -> Any:
    choices = typing.get_args(hint) or (hint,)
    if isinstance(value, dict):
        nested = next(choice for choice in choices if dataclasses.is_dataclass(choice))
        hints = typing.get_type_hints(nested)
        return nested(**{name: _from_json(entry, hints[name]) for name, entry in value.items()})
    if isinstance(value, list):
        return tuple(value)
    if isinstance(value, str) and Path in choices:
        return Path(value)
    return value


def _check_same_options(stored: dict[str, Any], now: dict[str, Any], path: Path, may_change: frozenset[str]) -> None:
    for name in sorted(set(stored) & set(now) - may_change):
        if stored[name] != now[name]:
            option = "--" + name.replace("_", "-")
            raise ValueError(
                f"{option} was {stored[name]} in {path} and is {now[name]} now: "
                "a resumed run keeps its options; start a new run for others"
            )


def _make_timestamped(parent: Path) -> Path:
    parent.mkdir(parents=True, exist_ok=True)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    number = 1
    while True:
        path = parent / (stamp if number == 1 else f"{stamp}_{number}")
        try:
            path.mkdir()
        except FileExistsError:
            number += 1
            continue
        break
    _link_latest(path)
    return path


def _link_latest(path: Path) -> None:
    link, unfinished = path.parent / "latest", path.parent / f".latest_{path.name}"
    try:
        unfinished.symlink_to(path.name, target_is_directory=True)
        os.replace(unfinished, link)
    except OSError as error:  # a file system without links
        logging.getLogger(__name__).warning("cannot link %s to the newest run: %s", link, error)


def _make_empty(path: Path, force: bool) -> None:
    path.mkdir(parents=True, exist_ok=True)
    entries = list(path.iterdir())
    if not entries:
        return
    if not (path / CONFIG).is_file():
        raise ValueError(f"{path} is not empty and holds no earlier run: name another folder with -o")
    if not force:
        raise ValueError(f"{path} holds an earlier run: --resume continues it, --force replaces it, -o names another")
    for entry in entries:
        if entry.name == CHECKPOINTS and entry.is_dir():
            shutil.rmtree(entry)
        elif entry.is_file() and entry.suffix in RESULT_SUFFIXES:
            entry.unlink()


def _exc_info(error: Exception) -> tuple[type[Exception], Exception, TracebackType | None]:
    return type(error), error, error.__traceback__

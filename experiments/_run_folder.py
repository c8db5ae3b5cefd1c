"""The folder of one run: where it lies, what may be overwritten, and files that appear whole or not at all."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from experiments._json import as_json, load_dataclass, load_json, write_json
from experiments._machine import environment

CONFIG, METRICS, HISTORY, LOG = "config.json", "metrics.json", "metrics.csv", "log.txt"
CHECKPOINTS = "checkpoints"
# --force removes these kinds of files only: a mistyped -o must not cost a user anything else.
RESULT_SUFFIXES = (".json", ".csv", ".txt", ".npy", ".npz", ".png", ".ply", ".g2o")
LOGGERS = ("dpmjax", "experiments", "__main__")
# Options that do not change what is computed.
FREE_OPTIONS = frozenset({"output", "resume", "force", "device", "coordinator", "num_processes", "process_id"})

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
    """Reads the options of the run in folder `path`; where it writes and the like gets its defaults.

    Raises:
        ValueError: its `config.json` holds an option that `config_type` does not have, or is no JSON.
    """
    return load_dataclass(path / CONFIG, config_type, ignore=FREE_OPTIONS)


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

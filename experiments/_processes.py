"""Several processes, on one host or many, that train as one: who they are, and what they agree on.

Everything here is free where there is only one process.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from experiments._command import StopFlag

TreeT = TypeVar("TreeT")
# Above all numbers of signals.
_FAILED = 1000
AUTO = "auto"
# A process that is not heard of for so long is taken for dead, and the others end.
_SILENCE_S = 300


class OtherProcessError(RuntimeError):
    """Another of the processes failed; what it says itself is the reason."""


def join_processes(coordinator: str | None, num_processes: int | None, process_id: int | None) -> None:
    """Makes this process one of several; nothing where none of the three is given. To be called before JAX is used.

    Args:
        coordinator: HOST:PORT on which process 0 listens, or `auto`: what the scheduler that started the processes
            (Slurm, Open MPI, a TPU pod) says of all three.
        num_processes: how many there are.
        process_id: which of them this one is, counted from 0.

    Raises:
        ValueError: options that do not go together, or the others do not come.
    """
    if coordinator is None:
        if num_processes is not None or process_id is not None:
            raise ValueError("--num-processes and --process-id need --coordinator HOST:PORT")
        return
    is_auto = coordinator == AUTO
    if not is_auto and (num_processes is None or process_id is None):
        raise ValueError(f"--coordinator {coordinator}: --num-processes and --process-id are needed with it")
    if num_processes is not None and process_id is not None and not 0 <= process_id < num_processes:
        raise ValueError(f"--process-id: expected from 0 to {num_processes - 1}, got {process_id}")
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            None if is_auto else coordinator, num_processes, process_id, heartbeat_timeout_seconds=_SILENCE_S
        )
    except (RuntimeError, ValueError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"--coordinator {coordinator}: the processes do not find each other: {said}") from error


def is_first() -> bool:
    """Whether this is the process that writes, prints and shows progress; True where there is only one."""
    import jax

    return jax.process_index() == 0


def largest(number: int) -> int:
    """The largest of the numbers that the processes give."""
    from jax.experimental import multihost_utils

    return number if _are_alone() else int(np.max(multihost_utils.process_allgather(np.int32(number))))


def from_first(tree: TreeT) -> TreeT:
    """What the first process has, for all; every process gives a tree of the same structure, shapes and types."""
    import jax
    from jax.experimental import multihost_utils

    if _are_alone():
        return tree
    return multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, tree))  # type: ignore[no-any-return]


def merged(table: dict[str, Any]) -> dict[str, Any]:
    """The entries of all processes; values that JSON can say."""
    from jax.experimental import multihost_utils

    if _are_alone():
        return table
    written = np.frombuffer(json.dumps(table).encode(), np.uint8)
    padded = np.zeros(largest(len(written)), np.uint8)
    padded[: len(written)] = written
    rows = np.asarray(multihost_utils.process_allgather(padded))
    return {name: value for row in rows for name, value in json.loads(row.tobytes().rstrip(b"\0")).items()}


@contextmanager
def together(stop: StopFlag | None = None) -> Iterator[None]:
    """What is done in the block succeeds in all processes, or is given up in all; all ask to stop if one is asked to.

    Args:
        stop: gets the signal that any of the processes received.

    Raises:
        OtherProcessError: the block failed in another process. Where it failed, its own error goes on.
    """
    failure: Exception | None = None
    try:
        yield
    except Exception as error:
        failure = error
    said = largest(_FAILED if failure is not None else (stop.received or 0) if stop is not None else 0)
    if failure is not None:
        raise failure
    if said == _FAILED:
        raise OtherProcessError("another process failed; it says why")
    if said and stop is not None:
        stop.request(said)


def _are_alone() -> bool:
    import jax

    return jax.process_count() == 1

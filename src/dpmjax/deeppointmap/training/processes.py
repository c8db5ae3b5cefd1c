"""Data-parallel training on all devices of one or several processes: sharding, and agreement between processes.

With one process, the functions that compare processes return their input at once.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

TreeT = TypeVar("TreeT")
BATCH_AXIS = "batch"
AUTO = "auto"
# A process without a heartbeat for this long counts as dead, and all processes end.
_HEARTBEAT_TIMEOUT_S = 300


class OtherProcessError(RuntimeError):
    """Another process failed; its own error message gives the reason."""


def join_processes(coordinator: str | None, num_processes: int | None, process_id: int | None) -> None:
    """Makes this process one of several; call it before JAX is used. Without any argument it does nothing.

    Args:
        coordinator: HOST:PORT on which process 0 listens; or `auto`, for the scheduler that started the processes
            (Slurm, Open MPI, a TPU pod).
        num_processes: number of processes.
        process_id: number of this process, from 0.

    Raises:
        ValueError: if the arguments do not go together, or the processes do not find each other.
    """
    if coordinator is None:
        if num_processes is not None or process_id is not None:
            raise ValueError("coordinator: expected HOST:PORT with num_processes and process_id, got none")
        return
    is_auto = coordinator == AUTO
    if not is_auto and (num_processes is None or process_id is None):
        raise ValueError(f"num_processes, process_id: expected both with coordinator {coordinator}")
    if num_processes is not None and process_id is not None and not 0 <= process_id < num_processes:
        raise ValueError(f"process_id: expected from 0 to {num_processes - 1}, got {process_id}")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    address = None if is_auto else coordinator
    try:
        jax.distributed.initialize(address, num_processes, process_id, heartbeat_timeout_seconds=_HEARTBEAT_TIMEOUT_S)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"coordinator {coordinator}: the processes do not find each other: {reason}") from error


def device_mesh() -> Mesh:
    """Makes a mesh of all devices of all processes.

    Returns:
        A mesh with one axis.
    """
    return Mesh(np.array(jax.devices()), (BATCH_AXIS,))


def place(tree: TreeT, mesh: Mesh, *, is_batch: bool = False) -> TreeT:
    """Puts arrays on the devices of a mesh.

    Args:
        tree: the same in every process; or a batch: the samples of this process, stacked along the first axis. Their
            number is that of the devices of this process in the mesh, or a multiple.
        mesh: mesh from `device_mesh`.
        is_batch: True spreads the first axis over the devices; False copies the tree to every device.

    Returns:
        The tree as arrays of all processes.
    """
    sharding = NamedSharding(mesh, PartitionSpec(BATCH_AXIS) if is_batch else PartitionSpec())
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), tree)


def is_first() -> bool:
    """Returns True in the one process that writes, prints and shows progress.

    Returns:
        True in process 0; True with one process.
    """
    return jax.process_index() == 0


def largest(number: int) -> int:
    """Computes the maximum over all processes.

    Args:
        number: value of this process.

    Returns:
        The maximum.
    """
    return number if _is_alone() else int(np.max(multihost_utils.process_allgather(np.int32(number))))


def from_first(tree: TreeT) -> TreeT:
    """Copies a tree from process 0 to all processes.

    Args:
        tree: tree of the same structure, shapes and types in every process.

    Returns:
        The tree of process 0.
    """
    if _is_alone():
        return tree
    return multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, tree))


def merged(table: dict[str, Any]) -> dict[str, Any]:
    """Merges the tables of all processes.

    Args:
        table: entries of this process; values that JSON can hold.

    Returns:
        The entries of all processes.
    """
    if _is_alone():
        return table
    written = np.frombuffer(json.dumps(table).encode(), np.uint8)
    padded = np.zeros(largest(len(written)), np.uint8)
    padded[: len(written)] = written
    rows = np.asarray(multihost_utils.process_allgather(padded))
    return {name: value for row in rows for name, value in json.loads(row.tobytes().rstrip(b"\0")).items()}


@contextmanager
def together() -> Iterator[None]:
    """Runs a block that succeeds in all processes or fails in all; a process where it failed raises its own error.

    Yields:
        Nothing.

    Raises:
        OtherProcessError: if the block failed in another process.
    """
    failure: Exception | None = None
    try:
        yield
    except Exception as error:
        failure = error
    any_failed = largest(int(failure is not None))
    if failure is not None:
        raise failure
    if any_failed:
        raise OtherProcessError("another process failed; its own message gives the reason")


def _is_alone() -> bool:
    return jax.process_count() == 1

"""Data-parallel training on all devices of one or several processes."""

from __future__ import annotations

from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

TreeT = TypeVar("TreeT")
BATCH_AXIS = "batch"
AUTO = "auto"


def join_processes(coordinator: str | None, num_processes: int | None, process_id: int | None) -> None:
    """Makes this process one of several; call it before JAX is used. Without a coordinator it does nothing.

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
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(None if coordinator == AUTO else coordinator, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"coordinator {coordinator}: {str(error).splitlines()[0]}") from error


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
    """Returns True in the one process that writes, prints and shows progress: process 0."""
    return jax.process_index() == 0


def from_first(tree: TreeT) -> TreeT:
    """Copies a tree from process 0 to all processes.

    Args:
        tree: tree of the same structure, shapes and types in every process.

    Returns:
        The tree of process 0; with one process, its input at once.
    """
    return tree if jax.process_count() == 1 else multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, tree))

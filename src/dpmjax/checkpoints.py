"""Checkpoints of any training state, written by orbax: the last two are kept, and a broken one is skipped."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

StateT = TypeVar("StateT")
LOGGER = logging.getLogger("dpmjax.checkpoint")


class Checkpoints:
    """The checkpoints in a folder, one for each saved step. With several processes, only one may use a folder."""

    def __init__(self, folder: Path) -> None:
        """Prepares the folder; the first `save` makes it.

        Args:
            folder: folder of the checkpoints.
        """
        processes = ocp.options.MultiprocessingOptions()
        if jax.process_count() > 1:  # without this, orbax waits for the other processes
            this = jax.process_index()
            processes = ocp.options.MultiprocessingOptions(this, {this}, barrier_sync_key_prefix=f"process_{this}")
        self._options = ocp.CheckpointManagerOptions(
            max_to_keep=2, create=False, enable_async_checkpointing=False, multiprocessing_options=processes
        )
        self._folder = folder.resolve()

    def save(self, step: int, state: object) -> None:
        """Writes a state; the same step is not written twice.

        Args:
            step: number of steps done.
            state: any pytree of arrays.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._manager() as manager:
            if step not in manager.all_steps():
                manager.save(step, args=ocp.args.StandardSave(_numbered(state)))
                manager.wait_until_finished()

    def restore_latest(self, like: StateT, *, fallback: StateT) -> StateT:
        """Reads the newest state that is not broken.

        Args:
            like: a state of the same structure, shapes and types.
            fallback: the result without a readable checkpoint.

        Returns:
            The state.
        """
        steps: list[int] = []
        if self._folder.is_dir():
            with self._manager() as manager:
                steps = sorted(manager.all_steps(), reverse=True)
        states = (self.restore(step, like) for step in steps)
        return next((state for state in states if state is not None), fallback)

    def restore(self, step: int, like: StateT) -> StateT | None:
        """Reads the state of a step.

        Args:
            step: number of steps done.
            like: a state of the same structure, shapes and types.

        Returns:
            The state; None, with a warning, where it is missing or broken.
        """
        target = _numbered(like)
        try:
            with self._manager() as manager:
                restored = manager.restore(step, args=ocp.args.StandardRestore(target))
        except (ValueError, OSError, KeyError) as error:
            LOGGER.warning("checkpoint %d cannot be read (%s: %s)", step, self._folder, error)
            return None
        leaves = [jax.numpy.asarray(restored[name]) for name in target]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    def _manager(self) -> ocp.CheckpointManager:
        logging.getLogger("absl").setLevel(logging.ERROR)
        return ocp.CheckpointManager(self._folder, options=self._options)


def _numbered(state: object) -> dict[str, np.ndarray]:
    # Plain arrays by number, so that orbax restores arrays for all leaves.
    return {str(number): np.asarray(leaf) for number, leaf in enumerate(jax.tree.leaves(state))}

"""Checkpoints of a training state, by orbax: the last two are kept, and one that was cut off is passed over."""

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
    """The checkpoints in a folder, one a step.

    Of several processes one alone uses it, without the others.

    Args:
        folder: is made when the first one is saved.
        num_kept: older ones are removed.
    """

    def __init__(self, folder: Path, *, num_kept: int = 2) -> None:
        alone = None
        if jax.process_count() > 1:  # orbax would wait for the others
            this = jax.process_index()
            alone = ocp.options.MultiprocessingOptions(this, {this}, barrier_sync_key_prefix=f"process_{this}")
        self._options = ocp.CheckpointManagerOptions(
            max_to_keep=num_kept,
            create=False,
            enable_async_checkpointing=False,
            **({} if alone is None else {"multiprocessing_options": alone}),
        )
        self._folder = folder.resolve()

    def save(self, step: int, state: object) -> None:
        """Writes the state; the same step is not written twice."""
        logging.getLogger("absl").setLevel(logging.ERROR)
        self._folder.mkdir(parents=True, exist_ok=True)
        with ocp.CheckpointManager(self._folder, options=self._options) as manager:
            if step not in manager.all_steps():
                manager.save(step, args=ocp.args.StandardSave(jax.tree.map(np.asarray, state)))
                manager.wait_until_finished()

    def restore_latest(self, like: StateT, *, fallback: StateT) -> StateT:
        """The newest state that can be read.

        Args:
            like: a state of the same structure, shapes and types.
            fallback: what to return where there is none.

        Returns:
            The state.
        """
        if not self._folder.is_dir():
            return fallback
        logging.getLogger("absl").setLevel(logging.ERROR)
        target = jax.tree.map(np.asarray, like)
        with ocp.CheckpointManager(self._folder, options=self._options) as manager:
            for step in sorted(manager.all_steps(), reverse=True):
                try:
                    restored = manager.restore(step, args=ocp.args.StandardRestore(target))
                except (ValueError, OSError, KeyError, FileNotFoundError) as error:
                    LOGGER.warning("checkpoint %d cannot be read (%s); the one before is taken", step, error)
                    continue
                return jax.tree.map(jax.numpy.asarray, restored)
        return fallback

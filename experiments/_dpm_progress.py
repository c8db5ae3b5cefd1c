"""How far a training is: its state, and the best parameters so far. This is what its checkpoints hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flax.struct
import numpy as np
from jaxtyping import Float, Int

from dpmjax.deeppointmap import TrainingConfig, TrainingState
from dpmjax.types import AnyArray


@flax.struct.dataclass
class Progress:
    """The state and the best parameters.

    Attributes:
        state: after the last step.
        best_params: those with the best recall that was measured; the first ones before that.
        best_recall: that recall; -1 before the first.
        best_step: after how many steps it was measured; 0 before the first.
    """

    state: TrainingState
    best_params: dict[str, Any]
    best_recall: Float[AnyArray, ""]
    best_step: Int[AnyArray, ""]


def begin(state: TrainingState) -> Progress:
    """Nothing is measured yet."""
    return Progress(state, state.params, np.float32(-1), np.int32(0))


def after_measurement(progress: Progress, recall: float) -> Progress:
    """The parameters of the state are the best if no recall was better; of equal ones the later count."""
    if not recall >= float(progress.best_recall):
        return progress
    state = progress.state
    return Progress(state, state.params, np.float32(recall), np.int32(int(state.step)))


def before_step(progress: Progress, config: TrainingConfig) -> Progress:
    """At the beginning of the overlap part the state gets the best parameters, for its head is to belong to them."""
    if int(progress.state.step) != config.registration_steps or int(progress.best_step) == 0:
        return progress
    return replace(progress, state=replace(progress.state, params=progress.best_params))


def params_to_use(progress: Progress, config: TrainingConfig) -> dict[str, Any]:
    """The best ones; after the overlap part has begun those of the state, which are the best ones with a new head."""
    is_over = int(progress.state.step) > config.registration_steps
    return progress.state.params if is_over or int(progress.best_step) == 0 else progress.best_params

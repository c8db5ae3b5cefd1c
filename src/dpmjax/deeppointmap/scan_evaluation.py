"""Evaluation of a model on pairs of raw scans: the errors after each stage of `register`, its confidence, its times.

pairs = read_scan_pairs(drive, draw_scan_pairs(drive, "near", 30))
evaluation = evaluate_scan_pairs(model, pairs)
evaluation.refined.recall
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.confidence import MatchEvidence, calibrated_probability, gather_evidence
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.motion_choice import choose_motion, refine_motion
from dpmjax.deeppointmap.scan_pairs import ScanPair
from dpmjax.deeppointmap.scan_registration import distinct_motions, match_clouds
from dpmjax.deeppointmap.verification import measure_scan
from dpmjax.metrics.poses import RegistrationRecall, registration_recall

Seconds = float | Float[np.ndarray, " p"]
"""Of one registration, or of each of several."""


class StageSeconds(NamedTuple):
    """Seconds of the stages of a registration, both scans together.

    Attributes:
        encode: preprocessing and network.
        measure: surfaces and free space of the scans.
        match: decoder and consensus.
        verify: comparison of the hypotheses, the search among views included.
        refine: the final alignment.
    """

    encode: Seconds
    measure: Seconds
    match: Seconds
    verify: Seconds
    refine: Seconds

    @property
    def total(self) -> Seconds:
        """Seconds of all stages."""
        return sum(self[1:], self[0])


class StagedRegistration(NamedTuple):
    """A registration with the motion after each stage.

    Attributes:
        descriptors: `T_target_source` of the best hypothesis of the network alone.
        verified: the one that the scans agree with best.
        refined: the same after the final alignment.
        evidence: numbers that the confidence rests on.
        seconds: of each stage.
    """

    descriptors: Float[np.ndarray, "4 4"]
    verified: Float[np.ndarray, "4 4"]
    refined: Float[np.ndarray, "4 4"]
    evidence: MatchEvidence
    seconds: StageSeconds


class ScanEvaluation(NamedTuple):
    """Results of a model on pairs of scans.

    Attributes:
        descriptors: errors of the network alone.
        verified: errors after the verification by the scans.
        refined: errors after the final alignment.
        confidence: of each registration; a probability where the model is calibrated, else the mean score of the pairs
            of descriptors.
        T_target_source: refined motions.
        seconds: of the stages of each registration.
    """

    descriptors: RegistrationRecall
    verified: RegistrationRecall
    refined: RegistrationRecall
    confidence: Float[np.ndarray, " p"]
    T_target_source: Float[np.ndarray, "p 4 4"]
    seconds: StageSeconds


def register_in_stages(model: Model, pair: ScanPair) -> StagedRegistration:
    """Registers a pair as `register` does with `refine=True`, and measures each stage.

    Args:
        model: encoder and decoder.
        pair: two scans.

    Returns:
        The motion after each stage, and the seconds of each.
    """
    settings, clock = model.config.verification, _Clock()
    scans = pair.source, pair.target
    clouds = [jax.block_until_ready(encode(model, points)) for points in scans]
    clock.lap()
    source, target = (measure_scan(points, settings) for points in scans)
    clock.lap()
    hypotheses = match_clouds(model, *clouds, config=model.config.matching)
    motions = distinct_motions(hypotheses)
    clock.lap()
    verified = choose_motion(source, target, motions, settings)
    clock.lap()
    refined = refine_motion(source, target, verified, settings)
    clock.lap()
    evidence = gather_evidence(hypotheses, verified.row, verified.verification)
    found = motions[0], verified.T_target_source, refined.T_target_source
    return StagedRegistration(*found, evidence, StageSeconds(*clock.laps))


def evaluate_scan_pairs(
    model: Model, pairs: Iterable[ScanPair], *, on_pair: Callable[[], object] | None = None
) -> ScanEvaluation:
    """Registers pairs of scans and compares the motions with the true ones.

    Args:
        model: encoder and decoder.
        pairs: such as `read_scan_pairs` yields; the first one is registered twice, so that no time is that of a
            compilation.
        on_pair: called after each pair, to show progress.

    Returns:
        Errors, confidence and seconds; right is within 2 m and 5 degrees.
    """
    found: list[StagedRegistration] = []
    true = []
    for pair in pairs:
        if not found:
            register_in_stages(model, pair)
        found.append(register_in_stages(model, pair))
        true.append(pair.T_target_source)
        if on_pair is not None:
            on_pair()

    def errors(motions: list[Float[np.ndarray, "4 4"]]) -> RegistrationRecall:
        return registration_recall(np.reshape(motions, (-1, 4, 4)), np.reshape(true, (-1, 4, 4)))

    seconds = np.reshape([result.seconds for result in found], (-1, len(StageSeconds._fields)))
    return ScanEvaluation(
        descriptors=errors([result.descriptors for result in found]),
        verified=errors([result.verified for result in found]),
        refined=errors([result.refined for result in found]),
        confidence=np.array([_confidence(model, result.evidence) for result in found]),
        T_target_source=np.reshape([result.refined for result in found], (-1, 4, 4)),
        seconds=StageSeconds(*seconds.T),
    )


def _confidence(model: Model, evidence: MatchEvidence) -> float:
    calibration = model.config.calibration
    if calibration is None or evidence.of_scans is None:
        return float(evidence.of_clouds[1])
    return calibrated_probability(calibration, evidence)


class _Clock:
    """Seconds from each lap to the next."""

    def __init__(self) -> None:
        self.laps: list[float] = []
        self._last = time.perf_counter()

    def lap(self) -> None:
        now = time.perf_counter()
        self.laps.append(now - self._last)
        self._last = now

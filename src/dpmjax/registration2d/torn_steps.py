"""Torn steps: relative poses of two scans that fit each other before a refinement and not after it.

A loop over a long step, or a wrong pair in space, moves single scans away from their neighbours, beyond the basin of
convergence of an alignment. The pose graph is solved again with the previous relative poses of these steps.
"""

from __future__ import annotations

import numpy as np

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, join_edges
from dpmjax.registration2d.joint_alignment import JointAlignmentConfig, choose_pairs, solve_step
from dpmjax.registration2d.planar_scans import Floats
from dpmjax.registration2d.range_profiles import RangeProfiles
from dpmjax.registration2d.step_prior import StepPrior
from dpmjax.registration2d.step_scores import WEAK_SCORE, pair_scores
from dpmjax.registration2d.step_slides import slide_steps

# A step is torn where its score has fallen by this much, from a score that was not weak.
_LOST_SCORE = 0.25
# Gauss-Newton steps of the graph, and the least weight of a step, whose score may be negative.
_NUM_ROUNDS, _LEAST_WEIGHT = 5, 0.01


def restore_torn(
    profiles: RangeProfiles, steps: Floats, poses: Floats, config: JointAlignmentConfig, prior: StepPrior
) -> Floats | None:
    """Restores torn steps and distributes the difference over the pairs that constrain the map.

    Args:
        profiles: n scans in time order.
        steps: (n - 1, 3) T_scan_next before the refinement.
        poses: (n, 3) T_world_scan after the refinement.
        config: of the pairs in space.
        prior: of the steps; a step that is torn in `Slides` with this prior is shifted to its mode.

    Returns:
        (n, 3) T_world_scan, to be aligned again; None where no step is torn.
    """
    later, kept = np.arange(1, len(poses)), np.asarray(se2.relative(poses[:-1], poses[1:]))
    before, after = (pair_scores(profiles, later, later - 1, found) for found in (steps, kept))
    is_lost = (before > WEAK_SCORE) & (after < before - _LOST_SCORE)
    slides = slide_steps(profiles, later, later - 1, kept, prior)
    is_slid = slides.is_torn & (slides.scores > WEAK_SCORE) & ~is_lost
    if not (is_lost | is_slid).any():
        return None
    chain = Edges(later, later - 1, kept, np.maximum(after, _LEAST_WEIGHT))
    for rows, found, weights in ((is_lost, steps, before), (is_slid, slides.moved(kept), slides.scores)):
        measured = np.where(rows[:, None], found, chain.measurements)
        chain = chain._replace(measurements=measured, information=np.where(rows, weights, chain.information))
    edges = join_edges(_holding_pairs(profiles, poses, config), chain)
    scale = np.diag([1.0, 1.0, profiles.scans.typical_range**2])
    edges = edges._replace(information=edges.information[:, None, None] * scale)
    for _ in range(_NUM_ROUNDS):
        here = np.asarray(se2.relative(poses[edges.target], poses[edges.source]))
        pull = np.einsum("eij,ej->ei", edges.information, se2.relative(edges.measurements, here))
        poses = np.asarray(se2.compose(poses, solve_step(len(poses), edges._replace(measurements=here), pull)))
    return poses


def _holding_pairs(profiles: RangeProfiles, poses: Floats, config: JointAlignmentConfig) -> Edges:
    """Returns edges of the pairs that fit, without steps; their information is the scores (e,)."""
    source, target = choose_pairs(profiles.scans, poses, config)
    is_pair = source != target + 1
    source, target = source[is_pair], target[is_pair]
    relative = np.asarray(se2.relative(poses[target], poses[source]))
    scores = pair_scores(profiles, source, target, relative)
    fits = scores > WEAK_SCORE
    return Edges(source[fits], target[fits], relative[fits], scores[fits])

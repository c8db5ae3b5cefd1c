"""Parts of a map that hang on the rest by weak joints are moved as a whole to where they fit better.

Where a place looks like another one, a map can go wrong by a single joint, and everything behind it is right in itself
and wrong together: no scan alone wants to move. So the map is cut at its weakest joints, and the smaller part goes to
the best of the places that any pair across the cut offers.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.registration.pair_search import Floats
from dpmjax.registration.pose_scoring import MapJudge, Offers, add_up, is_firmly_more


def move_blocks(poses: Floats, offers: Offers, judge: MapJudge) -> tuple[Floats, int]:
    """Cuts the map at its weakest joints, one after the other, and moves what is better elsewhere.

    Args:
        poses: (n, 3) a map of all scans.
        offers: of all pairs.
        judge: of the map.

    Returns:
        (n, 3) poses, and how many blocks have moved.
    """
    moved = 0
    for cut in range(judge.config.num_cuts):
        blocks = weakest_cuts(pair_values(poses, judge), judge.config.num_cuts)
        if cut >= len(blocks):
            break
        place = _better_place(poses, blocks[cut], offers, judge)
        if place is not None:
            poses = poses.copy()
            poses[blocks[cut]] = se2.compose(place, poses[blocks[cut]])
            moved += 1
    return poses, moved


def pair_values(poses: Floats, judge: MapJudge) -> Floats:
    """(n, n) what each pair of scans says of the map, below the diagonal; 0 for those too far apart to judge."""
    source, target = (x.astype(np.int64) for x in np.nonzero(np.tri(len(poses), k=-1, dtype=bool)))
    relative = se2.relative(poses[target], poses[source])
    near = np.hypot(relative[:, 0], relative[:, 1]) < judge.config.radius * judge.scale
    values = np.zeros((len(poses), len(poses)))
    values[source[near], target[near]] = judge.of_pairs(source[near], target[near], relative[near])
    return values


def weakest_cuts(values: Floats, count: int) -> list[NDArray[np.bool_]]:
    """The smaller sides (n,) of the cuts at the weakest joints of the best tree of pairs, the weakest first."""
    num_scans = len(values)
    cost = np.tril(values.max() + 1.0 - np.maximum(values, 0.0), k=-1)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(scipy.sparse.csr_matrix(cost)).tocoo()
    blocks = []
    for joint in np.argsort(-tree.data)[:count]:
        keep = np.arange(len(tree.data)) != joint
        rest = scipy.sparse.coo_matrix((tree.data[keep], (tree.row[keep], tree.col[keep])), shape=tree.shape)
        _, label = scipy.sparse.csgraph.connected_components(rest, directed=False)
        side = label == label[tree.row[joint]]
        blocks.append(side if 2 * side.sum() <= num_scans else ~side)
    return blocks


def _better_place(poses: Floats, block: NDArray[np.bool_], offers: Offers, judge: MapJudge) -> Floats | None:
    """The motion (3,) in the world of the block to the best place that offers across the cut give; None: it stays."""
    across = np.flatnonzero(block[offers.scan] & ~block[offers.anchor])
    across = across[np.argsort(-offers.scores[across], kind="stable")[: judge.config.num_block_places]]
    places = se2.compose(poses[offers.anchor[across]], offers.poses[across])
    motions = se2.compose(places, se2.inverse(poses[offers.scan[across]]))
    motions = np.concatenate([np.zeros((1, 3)), motions])
    inside, outside = np.flatnonzero(block), np.flatnonzero(~block)
    moved = se2.compose(motions[:, None], poses[inside][None])
    apart = moved[:, :, None, :2] - poses[outside][None, None, :, :2]
    which, i, j = np.nonzero(np.hypot(apart[..., 0], apart[..., 1]) < judge.config.radius * judge.scale)
    value = judge.of_pairs(inside[i], outside[j], se2.relative(poses[outside[j]], moved[which, i]))
    # Pairs on one side of the cut are the same for all motions.
    is_kept = np.tri(len(poses), k=-1, dtype=bool) & (block == block[:, None])
    one, other = (x.astype(np.int64) for x in np.nonzero(is_kept))
    kept = pair_values(poses, judge)[one, other]
    motion = np.concatenate([np.repeat(np.arange(len(motions)), len(one)), which])
    first = np.concatenate([np.tile(one, len(motions)), inside[i]])
    second = np.concatenate([np.tile(other, len(motions)), outside[j]])
    value = np.concatenate([np.tile(kept, len(motions)), value])
    row = np.concatenate([motion, motion]) * len(poses) + np.concatenate([first, second])
    said = add_up(row, np.concatenate([value, value]), len(motions) * len(poses)).reshape(len(motions), -1).sum(axis=1)
    best = int(said.argmax())
    return motions[best] if is_firmly_more(said[best], said[0]) else None

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.registration.visibility import compare_views
from dpmjax.types import ScanSet

NUM_BEAMS = 90


def ring(radius: float | np.ndarray, centre: tuple[float, float] = (0.0, 0.0)) -> ScanSet:
    """What a sensor away from the middle of round walls sees of them."""
    angle = np.arange(NUM_BEAMS) * 2 * np.pi / NUM_BEAMS
    direction, centre = np.stack([np.cos(angle), np.sin(angle)], -1), np.asarray(centre)
    along = direction @ centre
    reach = -along + np.sqrt(along**2 - centre @ centre + np.square(radius))
    return ScanSet(jnp.asarray((direction * reach[:, None])[None], jnp.float32), jnp.ones((1, NUM_BEAMS), bool))


def counts(source: ScanSet, target: ScanSet, pose=(0.0, 0.0, 0.0)) -> tuple[int, int, int]:
    found = compare_views(source, target, jnp.asarray([pose], jnp.float32), jnp.float32(0.5))
    return int(found.num_seen[0]), int(found.num_matched[0]), int(found.num_crossed[0])


def test_a_scan_does_not_contradict_itself() -> None:
    assert counts(ring(10.0), ring(10.0)) == (2 * NUM_BEAMS, 2 * NUM_BEAMS, 0)


@pytest.mark.parametrize("shift", [(2.0, 0.0), (-1.0, 1.5)])
def test_two_views_of_one_place_do_not_contradict(shift: tuple[float, float]) -> None:
    seen, matched, crossed = counts(ring(10.0, shift), ring(10.0), (*shift, 0.0))
    assert seen > NUM_BEAMS
    assert crossed == 0
    assert matched == seen


def test_a_wall_that_is_seen_through_counts_as_crossed() -> None:
    # The target's beams go on to 10 where the source has a wall at 6; beams of the source end before the target's wall.
    seen, matched, crossed = counts(ring(6.0), ring(10.0))
    assert (seen, matched, crossed) == (2 * NUM_BEAMS, 0, NUM_BEAMS)


def test_a_wrong_place_is_crossed_in_part() -> None:
    _, _, crossed = counts(ring(10.0), ring(10.0), (4.0, 0.0, 0.0))
    assert crossed > 10


def test_masked_beams_neither_see_nor_are_seen() -> None:
    full = ring(10.0)
    none = ScanSet(full.points, jnp.zeros_like(full.mask))
    assert counts(none, full) == (0, 0, 0)
    half = ScanSet(ring(6.0).points, full.mask.at[:, ::2].set(False))
    assert counts(half, ring(10.0))[2] == NUM_BEAMS // 2

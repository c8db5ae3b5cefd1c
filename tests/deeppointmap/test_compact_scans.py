"""Laws of compact scans: descriptors are kept exactly, and verification by the thinned scans finds the same motion."""

from __future__ import annotations

import jax
import numpy as np

from dpmjax.deeppointmap import init_model, model_preset
from dpmjax.deeppointmap.compact_scans import compact_scan, expand_scan
from dpmjax.deeppointmap.model import model_fingerprint
from dpmjax.deeppointmap.motion_choice import choose_motion, refine_motion
from dpmjax.deeppointmap.verification import VerificationConfig, measure_scan
from dpmjax.geometry import rigid
from dpmjax.geometry.bearing import directions_of
from dpmjax.types import DescriptorCloud
from tests.scans.surface_scenes import motion, seen_from, street

CONFIG = VerificationConfig()
T_WORLD_A, T_WORLD_B = motion(5, (1, -2, 0), 1), motion(130, (-4, 3, 0))
T_TRUE = rigid.inverse(T_WORLD_B) @ T_WORLD_A
RNG = np.random.default_rng(0)
CLOUD = DescriptorCloud(
    RNG.normal(0, 20, (16, 3)).astype(np.float32), RNG.normal(size=(16, 8)).astype(np.float32), RNG.random(16) > 0.2
)


def test_thinned_scans_find_the_same_motion() -> None:
    scans = [measure_scan(seen_from(street(seed), T), CONFIG) for seed, T in enumerate((T_WORLD_A, T_WORLD_B))]
    found = [expand_scan(compact_scan(CLOUD, scan, max_points=800)).measured for scan in scans]
    hypotheses = np.stack([motion(200, (3, 0, 0)), T_TRUE @ motion(3, (1.0, -0.8, 0.1))])
    chosen = choose_motion(*found, hypotheses, CONFIG)
    T = refine_motion(*found, chosen, CONFIG).T_target_source
    assert chosen.row == 1
    assert np.linalg.norm((rigid.inverse(T_TRUE) @ T)[:3, 3]) < 0.03
    assert chosen.verification.gap > 0.2


def test_descriptors_are_kept_exactly() -> None:
    compact = compact_scan(CLOUD, measure_scan(seen_from(street(0), T_WORLD_A), CONFIG))
    for name in ("positions", "features", "mask"):
        np.testing.assert_array_equal(getattr(compact.descriptors, name), getattr(CLOUD, name))
    np.testing.assert_array_equal(compact.descriptors.directions, directions_of(CLOUD))


def test_other_parameters_have_another_fingerprint() -> None:
    config = model_preset("tiny")
    first, other = (init_model(jax.random.key(seed), config) for seed in (0, 1))
    assert model_fingerprint(first) == model_fingerprint(jax.device_get(first))
    assert model_fingerprint(first) != model_fingerprint(other)
    assert len(model_fingerprint(first)) == 16

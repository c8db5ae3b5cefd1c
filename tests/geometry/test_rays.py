import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import sample_free_space
from dpmjax.geometry.sampling import typical_range
from tests.tolerances import ROUNDING


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("is_shared", [True, False])
def test_samples_lie_on_their_segments(dim: int, is_shared: bool) -> None:
    rng = np.random.default_rng(0)
    origin, points = rng.normal(size=dim).astype(np.float32), rng.normal(size=(7, dim)).astype(np.float32)
    factors = rng.uniform(size=4 if is_shared else (7, 4)).astype(np.float32)
    samples = np.asarray(sample_free_space(origin, points, factors))
    for beam, i in np.ndindex(7, 4):
        factor = factors[i] if is_shared else factors[beam, i]
        np.testing.assert_allclose(samples[beam, i], (1 - factor) * origin + factor * points[beam], **ROUNDING)


def test_wrong_shapes_are_named(as_user) -> None:
    with pytest.raises(ValueError, match="^origin: expected shape"):
        sample_free_space(jnp.zeros(3), jnp.zeros((4, 2)), jnp.ones(3))
    with pytest.raises(ValueError, match="^factors: expected shape"):
        sample_free_space(jnp.zeros(2), jnp.zeros((4, 2)), jnp.ones((5, 3)))


def test_typical_range_is_what_nine_beams_in_ten_stay_below() -> None:
    # Beam k of scan s ends at range s * k, k from 0 to 100. Masked beams and empty scans do not count.
    ranges = np.arange(101.0) * np.array([[1], [2], [7], [0]])
    points = ranges[..., None] * np.array([0.6, 0.8])
    mask = np.broadcast_to(np.array([[True]] * 3 + [[False]]), ranges.shape)
    assert typical_range(points, mask) == pytest.approx(180.0)
    hidden = np.where(np.arange(101) > 50, np.nan, 1.0)[:, None] * points
    assert typical_range(hidden, mask & (np.arange(101) <= 50)) == pytest.approx(90.0)
    with pytest.raises(ValueError, match="^mask: expected at least one valid beam"):
        typical_range(points, np.zeros_like(mask))

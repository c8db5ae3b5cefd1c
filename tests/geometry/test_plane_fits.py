"""Laws of planes through neighbourhoods."""

import numpy as np
import pytest

from dpmjax.geometry.planes import fit_planes


def neighbourhoods(rng: np.random.Generator, spread: tuple[float, float, float], count: int = 200) -> np.ndarray:
    """Random clouds of twelve points, stretched along random axes and moved: (count, 12, 3)."""
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return (rng.normal(size=(count, 12, 3)) * spread) @ axes + rng.normal(size=(count, 1, 3))


@pytest.mark.parametrize("spread", [(1.0, 1.0, 0.01), (1.0, 0.5, 0.2), (1e-4, 3e-4, 1e-6), (300.0, 0.3, 100.0)])
def test_planes_are_those_of_the_eigenvectors(spread) -> None:
    rng = np.random.default_rng(0)
    points, is_near = neighbourhoods(rng, spread), rng.random((200, 12)) < 0.8
    is_near[:, :5] = True
    found = fit_planes(tuple(np.where(is_near[..., None], points, 1e9).transpose(2, 0, 1)), is_near)
    for cloud, kept, normal, flatness in zip(points, is_near, found.normals, found.flatness, strict=True):
        values, vectors = np.linalg.eigh(np.cov(cloud[kept].T, bias=True))
        assert flatness == pytest.approx((values[1] - values[0]) / values[2], abs=1e-9)
        if flatness > 1e-3:
            assert abs(normal @ vectors[:, 0]) == pytest.approx(1, abs=1e-9)


def test_degenerate_neighbourhoods_are_finite_and_not_flat() -> None:
    rng = np.random.default_rng(0)
    point = np.zeros((1, 12, 3))
    line = np.arange(12.0)[None, :, None] * np.array([1.0, 2.0, -1.0])
    sphere = np.concatenate([np.eye(3), -np.eye(3)] * 2)[None]
    clouds = np.concatenate([point, line, sphere])
    found = fit_planes(tuple(clouds.transpose(2, 0, 1)), np.ones((3, 12), bool))
    assert np.isfinite(found.normals).all()
    np.testing.assert_allclose(found.flatness, 0, atol=1e-7)
    alone = rng.random((3, 12)) < 0
    alone[:, 0] = True
    assert fit_planes(tuple(clouds.transpose(2, 0, 1)), alone).flatness.max() == 0

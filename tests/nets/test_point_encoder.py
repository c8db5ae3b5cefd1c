import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap.model import Model, encode_pyramid, init_model, model_shapes
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.geometry.bearing import ray_directions, to_ray_frame
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage, build_pyramid_on_host
from dpmjax.nets import DecoderConfig, EncoderConfig
from dpmjax.types import PointPyramid
from tests.tolerances import ROUNDING

CONFIG = ModelConfig(
    pyramid=PyramidConfig((PyramidStage(24, (0.3, 0.5), 6), PyramidStage(6, (1.0,), 3)), 1),
    encoder=EncoderConfig(stem_channels=4, expansion=2, output_channels=10),
    decoder=DecoderConfig(input_channels=10, model_channels=16, num_heads=2),
)


@pytest.fixture(scope="module")
def model() -> Model:
    return init_model(jax.random.key(0), CONFIG)


def points(seed: int, num_points: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (num_points, 3)).astype(np.float32)


def pyramid_of(cloud: np.ndarray, capacity: int | None = None, config: ModelConfig = CONFIG) -> PointPyramid:
    capacity = len(cloud) if capacity is None else capacity
    front = np.zeros((capacity, 3), np.float32)
    front[: len(cloud)] = cloud
    return jax.device_put(build_pyramid_on_host(front, np.arange(capacity) < len(cloud), config.pyramid))


def poisoned(pyramid: PointPyramid) -> PointPyramid:
    """The same with NaN wherever nothing is."""
    levels = tuple(
        level.replace(positions=jnp.where(level.mask[:, None], level.positions, jnp.nan)) for level in pyramid.levels
    )
    return pyramid.replace(levels=levels)


@pytest.mark.slow
def test_padded_equals_unpadded(model: Model) -> None:
    # Five points fewer than the first level has room for.
    cloud = points(1, 19)
    found = encode_pyramid(model, poisoned(pyramid_of(cloud, capacity=64)))
    stages = (PyramidStage(19, (0.3, 0.5), 6), *CONFIG.pyramid.stages[1:])
    unpadded = Model(model.params, ModelConfig(PyramidConfig(stages, 1), CONFIG.encoder, CONFIG.decoder))
    expected = encode_pyramid(unpadded, pyramid_of(cloud, config=unpadded.config))
    np.testing.assert_array_equal(found.mask, np.arange(24) < 19)
    np.testing.assert_allclose(found.features[:19], expected.features, **ROUNDING)
    np.testing.assert_allclose(found.positions[:19], expected.positions, **ROUNDING)
    assert not found.features[19:].any()
    assert not found.positions[19:].any()


def test_order_of_neighbours_changes_nothing(model: Model) -> None:
    pyramid = pyramid_of(points(3))
    reverse = lambda blocks: tuple(block[:, ::-1] for block in blocks)  # noqa: E731
    levels = tuple(level.replace(neighbours=reverse(level.neighbours)) for level in pyramid.levels)
    found = encode_pyramid(model, pyramid.replace(levels=levels))
    np.testing.assert_array_equal(found.features, encode_pyramid(model, pyramid).features)


def test_empty_cloud_has_no_descriptors(model: Model) -> None:
    pyramid = pyramid_of(points(4))
    levels = tuple(level.replace(mask=jnp.zeros_like(level.mask)) for level in pyramid.levels)
    cloud = encode_pyramid(model, poisoned(pyramid.replace(levels=levels)))
    assert not cloud.mask.any()
    assert not cloud.features.any()
    assert not cloud.positions.any()


@pytest.mark.slow
def test_gradient_is_finite_in_degenerate_clouds_too(model: Model) -> None:
    gradient_of = jax.jit(jax.grad(lambda model, pyramid: jnp.sum(encode_pyramid(model, pyramid).features ** 2)))
    for cloud in (np.zeros((19, 3), np.float32), points(5, 19)):
        gradient = gradient_of(model, poisoned(pyramid_of(cloud, capacity=30)))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert any(leaf.any() for leaf in jax.tree.leaves(gradient.params["encoder"]["stage_0"]))


@pytest.mark.slow
def test_paper_size_is_the_published_one() -> None:
    shapes = model_shapes(ModelConfig())
    counts = {part: sum(leaf.size for leaf in jax.tree.leaves(params)) for part, params in shapes.items()}
    assert counts == {"encoder": 3_824_224, "decoder": 2_776_260}
    assert ModelConfig().num_descriptors == 256


def test_wrong_pyramids_and_widths_are_named(as_user, model: Model) -> None:
    pyramid = pyramid_of(points(9))
    with pytest.raises(ValueError, match="^pyramid: expected 3 levels, got 2"):
        encode_pyramid(model, pyramid.replace(levels=pyramid.levels[:-1]))
    short = pyramid.levels[1].replace(neighbours=pyramid.levels[1].neighbours[:1])
    with pytest.raises(ValueError, match="^pyramid.levels.1.: expected 2 neighbourhoods, got 1"):
        encode_pyramid(model, pyramid.replace(levels=(pyramid.levels[0], short, *pyramid.levels[2:])))
    with pytest.raises(ValueError, match="^stem_channels: expected at least 1"):
        EncoderConfig(stem_channels=0)
    with pytest.raises(ValueError, match="^decoder.input_channels: expected the encoder's output_channels 128, got 64"):
        ModelConfig(decoder=DecoderConfig(input_channels=64))


def test_direction_along_the_ray_is_x() -> None:
    positions = np.array([[3.0, 4, 5], [0, 0, 2], [0, -2, 0]], np.float32)
    across = np.array([[-0.8, 0.6, 0], [0, 1, 0], [1, 0, 0]], np.float32)
    expected = np.array([[5.0, 0, 5], [0, 0, 2], [2, 0, 0]])
    np.testing.assert_allclose(to_ray_frame(positions, ray_directions(positions)), expected, atol=1e-6)
    np.testing.assert_allclose(to_ray_frame(across, ray_directions(positions)), np.tile([0.0, 1, 0], (3, 1)), atol=1e-6)

"""Our networks, matching and losses against the published network in NumPy (`reference_network.py`), random weights.

The file of the weights has the layout of the published checkpoints, so that its import is tested, too. One test
compares the reference itself with numbers of the published program; they lie outside the repository, and
`$DPMJAX_PARITY` names their folder.
"""

import json
import os
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

from dpmjax.deeppointmap import Model, ModelConfig, correlate, encode_pyramid, overlap, register
from dpmjax.deeppointmap.model import decode, predict_offsets
from dpmjax.deeppointmap.training.objective import ObjectiveConfig, TrainingSide, matching_loss, training_pairs
from dpmjax.geometry import rigid
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage, build_pyramid_on_host
from dpmjax.nets.decoder import DecoderConfig
from dpmjax.nets.point_encoder import EncoderConfig
from dpmjax.types import DescriptorCloud
from dpmjax.weights import load_model
from dpmjax.weights.torch_import import read_torch_file
from tests.weights import reference_network as reference
from tests.weights.published import published_tensors, write_checkpoint

FOLDER = Path(os.environ.get("DPMJAX_PARITY", Path(__file__).parents[3] / "shared" / "parity" / "small"))
# The largest difference, relative to the largest number: float32 through ten layers and three rounds of attention.
RELATIVE = 1e-4
# Enough descriptors (128) for the rounds of inliers, and heads of two channels.
CONFIG = ModelConfig(
    pyramid=PyramidConfig(
        stages=(PyramidStage(192, (0.1, 0.2), 8), PyramidStage(128, (0.2,), 8), PyramidStage(24, (0.4, 0.8, 0.8), 4)),
        num_interpolations=1,
    ),
    encoder=EncoderConfig(stem_channels=4, expansion=4, output_channels=16),
    decoder=DecoderConfig(input_channels=16, model_channels=16, num_layers=2),
)
POINTS, PADDING = 320, 32


def assert_near(found: jax.Array, expected: np.ndarray | float) -> None:
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= RELATIVE * np.abs(expected).max()


class Case(NamedTuple):
    """Two scans of one place: the model and its descriptors, and those of the reference."""

    model: Model
    network: reference.Network
    encoded: tuple[DescriptorCloud, DescriptorCloud]
    expected: tuple[reference.Cloud, reference.Cloud]
    T_b_a: np.ndarray


@pytest.fixture(scope="module", params=[0, 1])
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    path = tmp_path_factory.mktemp("published") / "weights.pth"
    settings = write_checkpoint(path, published_tensors(CONFIG, request.param), CONFIG)
    model = load_model(path)
    network = reference.network_of(read_torch_file(path), settings["encoder"], settings["coordinate_scale"])
    rng = np.random.default_rng(request.param)
    world = rng.uniform([-15, -15, -2], [15, 15, 4], (POINTS, 3))
    T_b_a = np.asarray(rigid.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 0.4])), np.float64)
    scans = (world, world @ T_b_a[:3, :3].T + T_b_a[:3, 3] + 0.1 * rng.normal(size=world.shape))
    scans = [(scan / settings["coordinate_scale"]).astype(np.float32) for scan in scans]
    padded = [np.concatenate([scan, np.full((PADDING, 3), np.nan, np.float32)]) for scan in scans]
    mask = np.arange(POINTS + PADDING) < POINTS
    pyramids = [build_pyramid_on_host(scan, mask, model.config.pyramid) for scan in padded]
    encoded = tuple(encode_pyramid(model, pyramid) for pyramid in pyramids)
    return Case(model, network, encoded, tuple(reference.encode(network, scan) for scan in scans), T_b_a)


def test_checkpoint_gives_the_published_network(case: Case) -> None:
    assert case.model.config.pyramid == CONFIG.pyramid
    assert (case.model.config.encoder, case.model.config.decoder) == (CONFIG.encoder, CONFIG.decoder)
    num_numbers = sum(x.size for part in (case.network.encoder, case.network.decoder) for x in part.values())
    assert sum(leaf.size for leaf in jax.tree.leaves(case.model.params)) == num_numbers


def test_descriptors_are_the_published_ones(case: Case) -> None:
    for cloud, expected in zip(case.encoded, case.expected, strict=True):
        assert cloud.mask.all()
        assert_near(cloud.positions, expected.positions)
        assert_near(cloud.features, expected.features)


def test_correlated_features_and_similarity_are_the_published_ones(case: Case) -> None:
    correlated = correlate(case.model, *case.encoded)
    expected = reference.correlate(case.network, *case.expected)
    for cloud, features in zip(correlated, expected, strict=True):
        assert_near(cloud.features, features)
    a, b = (np.asarray(decode(case.model, cloud.features, part="similarity_head"), np.float64) for cloud in correlated)
    assert_near(reference.cosines(a, b), reference.similarity(case.network, *expected))


def test_overlap_probability_is_the_published_one(case: Case) -> None:
    expected = reference.overlap_probability(case.network, *reference.correlate(case.network, *case.expected))
    assert 0.1 < expected < 0.9
    assert_near(overlap(case.model, *case.encoded), expected)


def test_registration_is_the_published_one(case: Case) -> None:
    match, expected = register(case.model, *case.encoded), reference.register(case.network, *case.expected)
    assert_near(match.T_target_source[:3, :3], expected.R)
    assert_near(match.T_target_source[:3, 3], expected.t)
    assert_near(match.rmse, expected.rmse)
    assert int(match.num_inliers) == len(expected.inlier_scores)
    assert_near(match.confidence, expected.inlier_scores[:30].mean())


def test_losses_and_accuracy_are_the_published_ones(case: Case) -> None:
    model, config = case.model, ObjectiveConfig()
    correlated = correlate(model, *case.encoded)
    close = training_pairs(*case.encoded, case.T_b_a, config=config)
    sides = []
    for here, there in ((0, 1), (1, 0)):
        cloud, own = case.encoded[here], correlated[here].features
        sides.append(
            TrainingSide(
                positions=cloud.positions,
                mask=cloud.mask,
                matched_features=decode(model, correlated[here].features, part="similarity_head"),
                coarse_features=decode(model, cloud.features, part="coarse_head"),
                close=close[here],
                offsets=predict_offsets(model, own[:, None], correlated[there].features, None, close[here].indices),
            )
        )
    total, terms = matching_loss(*sides, case.T_b_a, config=config)
    expected = reference.losses(case.network, *case.expected, case.T_b_a)
    assert int(terms.num_positives) > 20
    assert expected["top1_accuracy"] > 0
    assert_near(total, expected["total"])
    for name in ("pairing", "coarse", "offset", "top1_accuracy"):
        assert_near(getattr(terms, name), expected[name])


@pytest.mark.slow
def test_reference_gives_the_numbers_of_the_published_program() -> None:
    if not (FOLDER / "case.npz").is_file():
        pytest.skip(f"no case of the published networks in {FOLDER} (set DPMJAX_PARITY)")
    with np.load(FOLDER / "case.npz") as arrays:
        published = dict(arrays)
    settings = json.loads((FOLDER / "config.json").read_text())
    checkpoint = read_torch_file(FOLDER / "weights.pth")
    network = reference.network_of(checkpoint, settings["encoder"], settings["coordinate_scale"])
    clouds = [reference.encode(network, published[f"points_{name}"][~published[f"padding_{name}"]]) for name in "ab"]
    correlated = reference.correlate(network, *clouds)
    for name, cloud, features in zip("ab", clouds, correlated, strict=True):
        assert_near(cloud.positions, published[f"descriptor_xyz_{name}"])
        assert_near(cloud.features, published[f"descriptor_features_{name}"])
        assert_near(features, published[f"correlated_features_{name}"])
    assert_near(reference.similarity(network, *correlated), published["similarity"])
    assert_near(reference.overlap_probability(network, *correlated), published["overlap_probability"][0])
    match = reference.register(network, *clouds)
    assert_near(match.R, published["registration_rotation"])
    assert_near(match.t, published["registration_translation"])
    assert_near(match.rmse, published["registration_rmse"][0])
    assert_near(match.inlier_scores, published["registration_confidence"])
    found = reference.losses(network, *clouds, published["T_b_a"])
    for name in ("pairing", "offset", "total"):
        assert_near(found[name], published[f"loss_{name}"])
    assert_near(found["coarse"], published["loss_coarse_pairing"])
    assert_near(found["top1_accuracy"], published["top1_accuracy"])

"""A network that compiles in seconds, and scans for it: boxes about a street."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from dpmjax import deeppointmap as dpm
from dpmjax.deeppointmap.confidence import CLOUD_FEATURES, SCAN_FEATURES, Calibration, LogisticModel
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage
from dpmjax.io import LidarSequence
from dpmjax.nets.decoder import DecoderConfig
from dpmjax.nets.point_encoder import EncoderConfig
from dpmjax.scan import PreprocessConfig
from dpmjax.types import DescriptorCloud, Registration

MODEL = dpm.ModelConfig(
    pyramid=PyramidConfig(stages=(PyramidStage(32, (0.2,), 8), PyramidStage(8, (0.4,), 4)), num_interpolations=1),
    encoder=EncoderConfig(stem_channels=4, expansion=2, output_channels=8),
    decoder=DecoderConfig(input_channels=8, model_channels=12, num_layers=1, num_heads=2),
    preprocess=PreprocessConfig(capacity=128, num_outlier_neighbours=0, voxel_size_m=0.5),
    trained=("registration", "overlap"),
)
"""Random parameters answer as trained ones would, so that overlap and SLAM accept them."""

SLAM_MODEL = replace(
    MODEL,
    pyramid=replace(MODEL.pyramid, stages=(PyramidStage(512, (0.05,), 12), PyramidStage(16, (0.4,), 8))),
    preprocess=replace(MODEL.preprocess, capacity=2048),
)
"""Enough surface elements for odometry."""

TRAINING = dpm.TrainingConfig(
    model=MODEL,
    curriculum=(dpm.CurriculumStage(2, 3), dpm.CurriculumStage(4, 2)),
    sampling=dpm.SamplingConfig(num_scans=6, max_side=2),
    num_variants=4,
    thins_as_in_use=True,
    thins_maps=True,
    initialization="normal",
    objective=dpm.ObjectiveConfig(max_close=4, positive_radius_m=3.0, offset_radius_m=5.0),
    stages=("registration",),
    overlap=dpm.OverlapConfig(num_epochs=2, batch_pairs=4),
)


def cloud(positions: np.ndarray, mask: np.ndarray | None = None) -> DescriptorCloud:
    """Descriptors without features; all are there unless a mask is given."""
    mask = np.ones(len(positions), bool) if mask is None else mask
    return DescriptorCloud(jnp.asarray(positions), jnp.zeros((len(positions), 0)), jnp.asarray(mask))


def drive(seed: int = 0, num_scans: int = 24, step_m: float = 4.0) -> LidarSequence:
    """A straight drive past random points that stand still."""
    rng = np.random.default_rng(seed)
    world = rng.uniform([-30, -20, -1], [30 + num_scans * step_m, 20, 3], (1500, 3))
    poses = np.tile(np.eye(4), (num_scans, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(num_scans)

    def read_scan(index: int) -> np.ndarray:
        points = world - poses[index, :3, 3]
        return points[np.linalg.norm(points, axis=1) < 30].astype(np.float32)

    return LidarSequence(f"toy {seed}", tuple(map(str, range(num_scans))), read_scan, poses)


def store(*drives: LidarSequence) -> dpm.ScanStore:
    return dpm.ScanStore([dpm.prepare_drive(one, TRAINING) for one in drives or (drive(),)])


def assert_trees_equal(found: object, expected: object) -> None:
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def best_match(source, target, similarity, predict_offsets, *, config: dpm.MatchConfig) -> Registration:
    hypotheses = dpm.match_hypotheses(source, target, similarity, predict_offsets, config=config)
    return jax.tree.map(lambda leaf: leaf[0], hypotheses)


def calibration(of_clouds: float = 0.0, of_scans: float = 0.0, **more: LogisticModel) -> Calibration:
    """Constant log odds of clouds and of scans."""
    clouds = LogisticModel(CLOUD_FEATURES, (0.0,) * len(CLOUD_FEATURES), of_clouds)
    return Calibration(clouds, LogisticModel(SCAN_FEATURES, (0.0,) * len(SCAN_FEATURES), of_scans), **more)

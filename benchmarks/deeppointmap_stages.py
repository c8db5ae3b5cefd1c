"""The stages of the DeepPointMap benchmark, each run in a process of its own so that its peak memory is its own.

`benchmarks.deeppointmap` starts them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import dpmjax
from benchmarks.rows import Row, measure
from dpmjax.cli import peak_rss_gb
from dpmjax.deeppointmap import (
    CurriculumStage,
    SampleMaker,
    ScanStore,
    init_training,
    make_step,
    merge_clouds,
    prepare_drive,
    pyramid_of_cloud,
    training_preset,
)
from dpmjax.geometry import build_pyramid
from dpmjax.io import LidarSequence, open_lidar_sequence
from dpmjax.scans import preprocess_scan, preprocess_scan_on_host
from dpmjax.simulation import HDL64E, simulate_lidar_sequence

Scan = NDArray[np.float32]
DATA = Path(os.environ.get("DPMJAX_DATA", "../shared/data")) / "lidar_3d"
KITTI = ("kitti_00", "kitti_07", "kitti_raw_0013")
NOT_COMPILED = ("preprocess", "pyramid", "preprocess + encode")
"""Parts that run on the host, and the sum of parts that are compiled by then."""

SCANS_IN_MAP = 8
"""2048 descriptors at the size of the paper."""


def make_scans(folder: Path, quick: bool) -> list[Row]:
    """Writes scans for the later stages and returns their sizes: a simulated one, one of KITTI if found."""
    sensor = HDL64E.with_azimuths(256) if quick else HDL64E
    scans = {"town": simulate_lidar_sequence(0, sensor=sensor).read_scan(10)}
    for name in () if quick else KITTI:
        if (DATA / name).is_dir():
            scans["KITTI"] = open_lidar_sequence(DATA / name).read_scan(0)
            break
    for name, points in scans.items():
        np.save(folder / f"{name}.npy", points)
    return [Row(f"{name} scan", "size", len(points), "points") for name, points in scans.items()]


def read_scans(folder: Path) -> dict[str, Scan]:
    """Returns the scans that `make_scans` wrote, by name."""
    return {file.stem: np.load(file) for file in sorted(folder.glob("*.npy"), reverse=True)}


def time_encoding(folder: Path, quick: bool, *, preset: str) -> list[Row]:
    """Returns times of `dpmjax.encode` and of its parts: two on the host, one on the device."""
    model = _model(preset)
    rows = []
    for name, points in read_scans(folder).items():
        cloud = preprocess_scan_on_host(points, None, model.config.preprocess)
        pyramid = pyramid_of_cloud(cloud, model.config)
        parts: dict[str, Callable[[], object]] = {
            "preprocess": partial(preprocess_scan_on_host, points, None, model.config.preprocess),
            "pyramid": partial(pyramid_of_cloud, cloud, model.config),
            "network": partial(dpmjax.encode_pyramid, model, pyramid),
            "preprocess + encode": partial(dpmjax.encode, model, points),
        }
        rows += _timed(f"{preset}, {name} scan", parts, quick)
    return rows


def time_jax_builders(folder: Path, quick: bool, *, preset: str) -> list[Row]:
    """Returns times of preprocessing and pyramid by the JAX kernels."""
    model = _model(preset)
    points = jnp.asarray(read_scans(folder)["town"])
    config = model.config
    cloud = preprocess_scan(points, None, config.preprocess)
    scaled = cloud.points / config.scale_m
    parts: dict[str, Callable[[], object]] = {
        "preprocess in JAX": partial(preprocess_scan, points, None, config.preprocess),
        "pyramid in JAX": partial(build_pyramid, scaled, cloud.mask, config.pyramid),
        "network": partial(dpmjax.encode_pyramid, model, build_pyramid(scaled, cloud.mask, config.pyramid)),
    }
    return _timed(f"{preset}, town scan", parts, quick, repeats=5)


def time_matching(folder: Path, quick: bool, *, preset: str, num_target: int) -> list[Row]:
    """Returns times of the decoder alone, and of the whole registration of two descriptor clouds."""
    model = _model(preset)
    source, target = _cloud(model, model.config.num_descriptors, seed=0), _cloud(model, num_target, seed=1)
    parts: dict[str, Callable[[], object]] = {
        "correlate": partial(dpmjax.correlate, model, source, target),
        "registration (correlate, match, align)": partial(dpmjax.register, model, source, target),
    }
    return _timed(f"{preset}, {model.config.num_descriptors} x {num_target}", parts, quick)


def time_overlap(folder: Path, quick: bool, *, preset: str) -> list[Row]:
    """Returns times of the overlap prediction."""
    model = _model(preset)
    clouds = [_cloud(model, model.config.num_descriptors, seed=seed) for seed in range(2)]
    return _timed(f"{preset}, one pair", {"overlap": partial(dpmjax.overlap, model, *clouds)}, quick)


def time_training(folder: Path, quick: bool, *, preset: str) -> list[Row]:
    """Returns times of a training step on pairs of scans, as the curriculum begins, and the scans a second."""
    settings = training_preset(preset)
    num_scans = 4 if quick else settings.sampling.num_scans
    sampling = replace(settings.sampling, num_scans=num_scans)
    settings = replace(settings, curriculum=(CurriculumStage(2, 1),), sampling=sampling, num_variants=1)
    points = read_scans(folder)["town"]
    T_world_lidar = np.tile(np.eye(4), (num_scans, 1, 1))
    T_world_lidar[:, 0, 3] = np.linspace(0, 10, num_scans)
    drive = LidarSequence("town", ("town",) * num_scans, lambda _: points, T_world_lidar)
    with SampleMaker(ScanStore([prepare_drive(drive, settings)]), settings, seed=0) as maker:
        batch = maker(0)
    step = make_step(settings)
    state = init_training(jax.random.key(0), settings)
    timing = measure(step, state, batch, repeats=3 if quick else 12)
    case = f"{preset}, K = 2, {num_scans} scans: training step"
    return [*timing.rows(case), Row(case, "speed", num_scans / timing.median_s, "scans/s")]


def run_everything(folder: Path, quick: bool, *, preset: str) -> list[Row]:
    """Returns no rows; runs encoding, registration of scans and maps, and overlap, to measure the memory."""
    model = _model(preset)
    scan = next(iter(read_scans(folder).values()))
    cloud = dpmjax.encode(model, scan)
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf] * SCANS_IN_MAP), cloud)
    poses = jnp.tile(jnp.eye(4), (SCANS_IN_MAP, 1, 1)).at[:, 0, 3].set(jnp.arange(SCANS_IN_MAP))
    jax.block_until_ready(
        (
            dpmjax.register(model, cloud, scan),
            dpmjax.register(model, cloud, merge_clouds(stacked, poses)),
            dpmjax.overlap(model, cloud, cloud),
        )
    )
    return []


def time_products(folder: Path, quick: bool) -> list[Row]:
    """Returns the speed of the decoder's largest matrix product, which shows if the machine is busy."""
    product = jax.jit(jnp.matmul)
    a, b = jnp.ones((2304, 256)), jnp.ones((256, 768))
    timing = measure(product, a, b, repeats=5 if quick else 30)
    return [Row("float32 product 2304x256x768", "speed", 2e-9 * 2304 * 256 * 768 / timing.median_s, "GFLOP/s")]


def _model(preset: str) -> dpmjax.Model:
    # Speed does not depend on the values of the weights.
    return dpmjax.init_model(jax.random.key(0), dpmjax.model_preset(preset))


def _cloud(model: dpmjax.Model, num_descriptors: int, *, seed: int) -> dpmjax.DescriptorCloud:
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-40.0, 40.0, (num_descriptors, 3)).astype(np.float32)
    features = rng.normal(size=(num_descriptors, model.config.decoder.input_channels)).astype(np.float32)
    return dpmjax.DescriptorCloud(jnp.asarray(positions), jnp.asarray(features), jnp.ones(num_descriptors, bool))


def _timed(case: str, parts: dict[str, Callable[[], object]], quick: bool, repeats: int = 12) -> list[Row]:
    rows: list[Row] = []
    for name, function in parts.items():
        timing = measure(function, repeats=3 if quick else repeats).rows(f"{case}: {name}")
        rows += [row for row in timing if row.metric != "compile" or name not in NOT_COMPILED]
    return rows


STAGES: dict[str, Callable[[Path, bool], list[Row]]] = {
    "scans": make_scans,
    "products": time_products,
    **{f"encode {preset}": partial(time_encoding, preset=preset) for preset in ("tiny", "small", "paper")},
    **{f"JAX builders {preset}": partial(time_jax_builders, preset=preset) for preset in ("tiny", "small", "paper")},
    "match tiny": partial(time_matching, preset="tiny", num_target=256),
    "match scan": partial(time_matching, preset="paper", num_target=256),
    "match map": partial(time_matching, preset="paper", num_target=256 * SCANS_IN_MAP),
    **{f"train {preset}": partial(time_training, preset=preset) for preset in ("tiny", "small")},
    "overlap": partial(time_overlap, preset="paper"),
    "everything tiny": partial(run_everything, preset="tiny"),
    "everything paper": partial(run_everything, preset="paper"),
}


def stage_rows(stage: str, folder: Path, quick: bool) -> list[Row]:
    """Returns the rows of one stage, with the peak memory of this process."""
    return [*STAGES[stage](folder, quick), Row(f"process of {stage}", "peak memory", peak_rss_gb(), "GB")]

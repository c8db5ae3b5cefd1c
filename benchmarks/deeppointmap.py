"""DeepPointMap from a raw scan to descriptors, motions and overlap, beside the authors' program.

Each stage runs in a process of its own, so that its peak memory is its own. The input is a scan of the simulated town
(HDL-64E, about 100,000 points), and one of KITTI where `$DPMJAX_DATA/lidar_3d` (default `../shared/data`) has it. On
the CPU always, on a GPU too where JAX has one.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import dpmjax
from benchmarks import DATA, Row, in_new_process, measure
from dpmjax import deeppointmap as dpm
from dpmjax.cli import peak_rss_gb
from dpmjax.io import LidarSequence, open_lidar_sequence
from dpmjax.scan import preprocess_scan_on_host
from dpmjax.simulation import HDL64E, DriveConfig, Scene, TownConfig, simulate_scene

Scans = dict[str, np.ndarray]
Parts = dict[str, Callable[[], object]]

KITTI = ("kitti_00", "kitti_07", "kitti_raw_0013")
# Parts that run on the host, and the sum of parts that are compiled by then.
NOT_COMPILED = ("preprocess", "pyramid", "preprocess + encode")
# 2048 descriptors at the size of the paper.
SCANS_IN_MAP = 8

# The authors' program was measured once on two cores of an AMD EPYC with random weights (paper size, a KITTI scan of
# 122,500 points): milliseconds by case.
THEIRS = {
    "paper, KITTI scan: preprocess": 98.0,
    "paper, KITTI scan: pyramid": 990.0,
    "paper, KITTI scan: network": 250.0,
    "paper, KITTI scan: preprocess + encode": 1318.0,
    "paper, 256 x 256: registration (correlate, match, align)": 75.0,
    "paper, 256 x 256: overlap": 82.0,
    "paper, 256 x 2048: registration (correlate, match, align)": 540.0,
}


def run(quick: bool) -> list[Row]:
    """Returns rows of all stages on the CPU; then on the GPU, where JAX has one, under names that say so."""
    # Several processes share the GPU.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    sensor = HDL64E.with_azimuths(256) if quick else HDL64E
    scans: Scans = {"town": simulate_scene(Scene(0, TownConfig(), DriveConfig(), sensor)).read_scan(10)}
    recorded = [path for name in KITTI if not quick and (path := DATA / "lidar_3d" / name).is_dir()]
    if recorded:
        scans["KITTI"] = open_lidar_sequence(recorded[0]).read_scan(0)
    rows = [Row(f"{name} scan", "size", len(points), "points") for name, points in scans.items()]
    devices = {"": "cpu"} | ({"GPU, ": "cuda"} if jax.default_backend() == "gpu" else {})
    for prefix, platform in devices.items():
        for stage in QUICK if quick else STAGES:
            found = in_new_process(stage_rows, stage, scans, quick, JAX_PLATFORMS=platform)
            rows += [row._replace(case=prefix + row.case) for row in (found if prefix else with_theirs(found))]
    return rows


def stage_rows(stage: str, scans: Scans, quick: bool) -> list[Row]:
    """Returns the rows of one stage, with the peak memory of this process."""
    return [*STAGES[stage](scans, quick), Row(f"process of {stage}", "peak memory", peak_rss_gb(), "GB")]


def with_theirs(rows: list[Row]) -> list[Row]:
    """Returns the rows, each followed by the number of the authors' program, where there is one."""
    result = []
    for row in rows:
        result.append(row)
        if row.case in THEIRS and row.metric == "median":
            result.append(row._replace(metric="median, authors' program", value=THEIRS[row.case]))
    return result


def time_encoding(scans: Scans, quick: bool, *, preset: str) -> list[Row]:
    """Returns times of `dpmjax.encode` and of its parts: two on the host, one on the device."""
    model, rows = _model(preset), []
    for name, points in scans.items():
        cloud = preprocess_scan_on_host(points, None, model.config.preprocess)
        parts: Parts = {
            "preprocess": partial(preprocess_scan_on_host, points, None, model.config.preprocess),
            "pyramid": partial(dpm.pyramid_of_cloud, cloud, model.config),
            "network": partial(dpmjax.encode_pyramid, model, dpm.pyramid_of_cloud(cloud, model.config)),
            "preprocess + encode": partial(dpmjax.encode, model, points),
        }
        rows += _timed(f"{preset}, {name} scan", parts, quick)
    return rows


def time_matching(scans: Scans, quick: bool, *, preset: str, num_target: int) -> list[Row]:
    """Returns times of the decoder alone, of the whole registration of two descriptor clouds, and of their overlap."""
    model = _model(preset)
    source, target = _cloud(model, model.config.num_descriptors, seed=0), _cloud(model, num_target, seed=1)
    parts: Parts = {
        "correlate": partial(dpmjax.correlate, model, source, target),
        "registration (correlate, match, align)": partial(dpmjax.register, model, source, target),
        "overlap": partial(dpmjax.overlap, model, source, target),
    }
    return _timed(f"{preset}, {model.config.num_descriptors} x {num_target}", parts, quick)


def time_training(scans: Scans, quick: bool, *, preset: str) -> list[Row]:
    """Returns times of a training step on pairs of scans, as the curriculum begins, and the scans a second."""
    settings = dpm.training_preset(preset)
    num_scans = 4 if quick else settings.sampling.num_scans
    sampling = replace(settings.sampling, num_scans=num_scans)
    settings = replace(settings, curriculum=(dpm.CurriculumStage(2, 1),), sampling=sampling, num_variants=1)
    T_world_lidar = np.tile(np.eye(4), (num_scans, 1, 1))
    T_world_lidar[:, 0, 3] = np.linspace(0, 10, num_scans)
    drive = LidarSequence("town", ("town",) * num_scans, lambda _: scans["town"], T_world_lidar)
    batch = dpm.SampleMaker(dpm.ScanStore([dpm.prepare_drive(drive, settings)]), settings, seed=0)(0)
    state = dpm.init_training(jax.random.key(0), settings)
    timing = measure(dpm.make_step(settings), state, batch, repeats=3 if quick else 12)
    case = f"{preset}, K = 2, {num_scans} scans: training step"
    return [*timing.rows(case), Row(case, "speed", num_scans / timing.median_s, "scans/s")]


def _model(preset: str) -> dpmjax.Model:
    # Speed does not depend on the values of the weights.
    config = replace(dpmjax.model_preset(preset), trained=("registration", "overlap"))
    return dpmjax.init_model(jax.random.key(0), config)


def _cloud(model: dpmjax.Model, num_descriptors: int, *, seed: int) -> dpmjax.DescriptorCloud:
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-40.0, 40.0, (num_descriptors, 3)).astype(np.float32)
    features = rng.normal(size=(num_descriptors, model.config.decoder.input_channels)).astype(np.float32)
    return dpmjax.DescriptorCloud(jnp.asarray(positions), jnp.asarray(features), jnp.ones(num_descriptors, bool))


def _timed(case: str, parts: Parts, quick: bool) -> list[Row]:
    rows: list[Row] = []
    for name, function in parts.items():
        timing = measure(function, repeats=3 if quick else 12)
        rows += timing.rows(f"{case}: {name}", is_compiled=name not in NOT_COMPILED)
    return rows


STAGES: dict[str, Callable[[Scans, bool], list[Row]]] = {
    **{f"encode {preset}": partial(time_encoding, preset=preset) for preset in ("tiny", "small", "paper")},
    "match tiny": partial(time_matching, preset="tiny", num_target=256),
    "match scan": partial(time_matching, preset="paper", num_target=256),
    "match map": partial(time_matching, preset="paper", num_target=256 * SCANS_IN_MAP),
    **{f"train {preset}": partial(time_training, preset=preset) for preset in ("tiny", "small")},
}
QUICK = ("encode tiny", "match tiny")

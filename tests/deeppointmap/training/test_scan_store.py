"""Prepared drives: kept scans, scans that are read again, and bad scans."""

import functools
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from dpmjax import deeppointmap as dpm
from dpmjax.deeppointmap.training.preparation import scan_records
from dpmjax.deeppointmap.training.step import encode_sample
from dpmjax.geometry import rigid
from dpmjax.io import InputError
from dpmjax.sequences import LidarSequence
from tests.deeppointmap import toy


def short(*, num_scans: int = 4, bad: int | None = None) -> LidarSequence:
    drive = toy.drive(num_scans=num_scans)

    def read_scan(index: int) -> np.ndarray:
        if index == bad:
            raise InputError(str(index), "cut off", "leave it out")
        return drive.read_scan(index)

    return replace(drive, read_scan=read_scan)


def kept(drive: LidarSequence, config: dpm.TrainingConfig, folder: Path, *, seed: int = 0) -> dpm.PreparedDrive:
    """The drive with its file, which is made unless it is there."""
    path = dpm.prepared_path(drive, config, folder, seed)
    scans = dpm.prepare_variants(drive, range(len(drive)), config, seed)
    return dpm.find_prepared(path, drive.T_world_lidar) or dpm.store_scans(path, drive.T_world_lidar, scans, config)


def test_a_kept_file_is_read_instead_of_made_again(tmp_path) -> None:
    in_memory = dpm.prepare_drive(short(), toy.TRAINING)
    made = kept(short(), toy.TRAINING, tmp_path)
    made_at = made.pyramids.stat().st_mtime_ns
    found = kept(short(), toy.TRAINING, tmp_path)
    assert (found.pyramids, found.pyramids.stat().st_mtime_ns) == (made.pyramids, made_at)
    np.testing.assert_array_equal(np.load(found.pyramids), in_memory.pyramids)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".npy"]


def test_other_scans_or_settings_are_another_file(tmp_path) -> None:
    moving = replace(toy.TRAINING, augment=replace(toy.TRAINING.augment, max_yaw_rad=1.0))
    dropping = replace(toy.TRAINING, augment=replace(toy.TRAINING.augment, max_drop_ratio=0.1))
    first = dpm.prepared_path(short(), toy.TRAINING, tmp_path, 0)
    assert dpm.prepared_path(short(), moving, tmp_path, 0) == first
    for drive, config, seed in ((short(), dropping, 0), (short(num_scans=3), toy.TRAINING, 0), (short(), moving, 1)):
        assert dpm.prepared_path(drive, config, tmp_path, seed) != first


def test_a_bad_scan_is_empty_and_named(tmp_path) -> None:
    prepared = [kept(short(bad=2), toy.TRAINING, tmp_path) for _ in range(2)]
    assert prepared[0].bad == prepared[1].bad == {"2": "cut off; leave it out."}
    store = dpm.ScanStore(prepared[:1])
    scans, _ = store.read(np.arange(4), toy.TRAINING, np.random.default_rng(0))
    np.testing.assert_array_equal(scans.pyramids.num_points > 0, [True, True, False, True])


def test_poses_follow_the_motions_of_the_scans() -> None:
    store = dpm.ScanStore([dpm.prepare_drive(short(), toy.TRAINING)])
    scans, placed = store.read(np.arange(4), toy.TRAINING, np.random.default_rng(1))
    found = placed.T_world_scan @ scans.T_augmented_lidar
    np.testing.assert_allclose(found, short().T_world_lidar, atol=1e-4)


@pytest.mark.slow
def test_descriptors_are_placed_where_the_encoder_finds_them(model) -> None:
    store, model = (
        dpm.ScanStore([dpm.prepare_drive(short(), toy.TRAINING)]),
        dpm.init_model(jax.random.key(0), toy.TRAINING.model),
    )
    scans, placed = store.read(np.arange(4), toy.TRAINING, np.random.default_rng(1))
    clouds = jax.vmap(functools.partial(encode_sample, model))(scans)
    np.testing.assert_array_equal(clouds.mask, placed.mask)
    found = rigid.transform_points(placed.T_world_scan, np.asarray(clouds.positions))
    np.testing.assert_allclose(found[placed.mask], placed.positions_world[placed.mask], atol=1e-3)


FRESH = replace(toy.TRAINING, num_variants=0, thins_as_in_use=False)


@pytest.mark.slow
def test_scans_that_are_prepared_anew_need_no_file_and_depend_on_seed_and_step_alone() -> None:
    prepared = dpm.prepare_drive(short(bad=2), FRESH)
    assert dpm.stored_bytes(FRESH) == 0
    makers = [dpm.SampleMaker(dpm.ScanStore([prepared]), FRESH, seed=0) for _ in range(2)]
    toy.assert_trees_equal(makers[0](1), makers[1](1))
    store = dpm.ScanStore([prepared])
    rng = np.random.default_rng(0)
    stored = [store.read(np.arange(4), FRESH, rng)[0].pyramids for _ in range(6)]
    assert store.bad == {"2": "cut off; leave it out."}
    assert all(pyramids.num_points[2] == 0 for pyramids in stored)
    # Other points are dropped each time.
    assert len({pyramids.points[0].tobytes() for pyramids in stored}) == 6


def test_shuffled_points_are_another_choice_of_each_voxel_and_drops_come_before_the_capacity() -> None:
    """As published: all points in range have a chance, and the capacity is full where enough remain."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (4000, 3)).astype(np.float32)
    still = replace(toy.TRAINING.augment, max_drop_ratio=0.5, sector_probability=0.0, box_probability=0.0)
    config = replace(FRESH, augment=still)
    records = [scan_records(points, replace(config, num_variants=1), (0, number))[0] for number in range(5)]
    assert [int(record["num_points"]) for record in records] == [config.model.preprocess.capacity] * 5
    first, second = (record["points"][: record["num_points"]] * record["unit"] for record in records[:2])
    assert not np.array_equal(np.sort(first, axis=0), np.sort(second, axis=0))
    (again,) = scan_records(points, replace(config, num_variants=1), (0, 0))
    np.testing.assert_array_equal(again, records[0])


def test_the_size_of_prepared_scans_is_that_of_their_files(tmp_path) -> None:
    path = kept(short(), toy.TRAINING, tmp_path).pyramids
    assert 0 <= path.stat().st_size - 4 * dpm.stored_bytes(toy.TRAINING) < 16_384  # the header of the file
    assert round(dpm.stored_bytes(replace(dpm.training_preset("paper"), num_variants=4)) / 1e6, 2) == 3.29
    assert round(dpm.stored_bytes(dpm.training_preset("small")) / 1e6, 2) == 0.51

"""Registers each scan of a drive to its nearest keyframes, merged, by the decoder alone.

    python -m experiments.dpm_keyframes path/to/drive another/drive
    python -m experiments.dpm_keyframes path/to/drive --weights path/to/model.safetensors --keyframes 1 4

Keyframes are chosen by the true poses, as far apart as those of SLAM. Each scan is registered to the union of the N
nearest keyframes before it, the nearest first. A descriptor that lies within one spacing of a nearer keyframe's is left
out. Nothing is searched or verified: the first hypothesis of the decoder counts. A cell of the table has the number of
scans that are more than 2 m or 5 degrees off, and the median and the 95th percentile of the error. Results go to
results/dpm_keyframes/<time>/: table.md, metrics.json.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from tyro.conf import Positional, arg

from dpmjax import DescriptorCloud, cli, load_model, registration_recall, scans, slam
from dpmjax import deeppointmap as dpm
from dpmjax.io import LidarSequence

EXPERIMENT = "dpm_keyframes"


@dataclass(frozen=True, kw_only=True)
class Config(cli.ModelOptions, cli.RunOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="PATH ...")]
    """Folders of scans with poses."""
    keyframes: Annotated[tuple[int, ...], arg(metavar="N ...")] = (1, 4, 8, 16)
    """Numbers of keyframes that are merged, one column each."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, seed=0, keyframes=1)
        if not self.paths or not self.keyframes:
            raise ValueError("give at least one folder of scans and one number of keyframes")


def main(config: Config) -> list[cli.Row]:
    """Makes the rows that are missing, and writes the table and the numbers."""
    model = load_model(config.weights)
    drives = {drive.name: drive for drive in cli.open_evaluation_drives(config.paths, [])}

    def work(_: cli.TableRun, sequence: str) -> cli.Row:
        return evaluate(model, drives[sequence], config.keyframes)

    def report(rows: list[cli.Row]) -> cli.Summary:
        return cli.Summary({"weights": config.weights}, table(rows, config.keyframes))

    return cli.run_table(config, EXPERIMENT, [{"sequence": name} for name in drives], work, report)


def evaluate(model: dpm.Model, drive: LidarSequence, nums_keyframes: tuple[int, ...]) -> cli.Row:
    """Returns the errors of all scans after the first for each number of keyframes."""
    poses = np.asarray(drive.T_world_lidar, np.float64)
    points = [drive.read_scan(number) for number in range(len(drive))]
    clouds = jax.device_get(dpm.encode_scans(model, points).described)
    is_keyframe = choose_keyframes(poses[:, :3, 3], [keyframe_spacing_m(scan, model) for scan in points])
    row: cli.Row = {"num_scans": len(drive) - 1, "num_keyframes": int(is_keyframe.sum())}
    for num in nums_keyframes:
        found, true = [], []
        for number in range(1, len(drive)):
            rows = np.flatnonzero(is_keyframe[:number])
            distances = np.linalg.norm(poses[rows, :3, 3] - poses[number, :3, 3], axis=1)
            near = rows[np.argsort(distances, kind="stable")][:num]
            source = jax.tree.map(operator.itemgetter(number), clouds)
            target = merged(clouds, near, poses, num)
            hypotheses = dpm.match_clouds(model, source, target, config=model.config.matching)
            found.append(np.asarray(hypotheses.T_target_source[0], np.float64))
            true.append(np.linalg.inv(poses[near[0]]) @ poses[number])
        recall = registration_recall(np.stack(found), np.stack(true))
        errors = recall.translation_errors_m
        row[f"keyframes_{num}"] = {
            "num_wrong": int((~recall.is_right).sum()),
            "num_over_2_m": int((errors > 2).sum()),
            "median_error_m": float(np.median(errors)),
            "error_95_m": float(np.percentile(errors, 95)),
        }
    return row


def keyframe_spacing_m(points: np.ndarray, model: dpm.Model) -> float:
    """Returns the spacing of keyframes at a scan: a share of the median range of its points, as SLAM has it."""
    config, thinned = slam.FrontEndConfig(), scans.preprocess_scan_on_host(points, None, model.config.preprocess)
    ranges = np.linalg.norm(np.asarray(thinned.points)[np.asarray(thinned.mask)], axis=1)
    extent_m = float(np.median(ranges)) if len(ranges) else 0.0
    return float(np.clip(config.keyframe_share * extent_m, config.min_keyframe_m, config.max_keyframe_m))


def choose_keyframes(positions: np.ndarray, spacings_m: list[float]) -> np.ndarray:
    """Returns True for the scans that lie at least a spacing from the keyframes before them."""
    is_keyframe = np.zeros(len(positions), bool)
    for number, (position, spacing_m) in enumerate(zip(positions, spacings_m, strict=True)):
        distances = np.linalg.norm(positions[is_keyframe] - position, axis=1)
        is_keyframe[number] = distances.min(initial=np.inf) >= spacing_m
    return is_keyframe


def merged(clouds: DescriptorCloud, rows: np.ndarray, poses: np.ndarray, capacity: int) -> DescriptorCloud:
    """Returns the thinned union of some keyframes in the frame of the first; the size is a power of two."""
    padded = np.concatenate([rows, np.full(capacity - len(rows), rows[0])])
    some = jax.tree.map(lambda leaf: leaf[padded], clouds)
    some = replace(some, mask=some.mask & (np.arange(capacity) < len(rows))[:, None])
    T_map_scan = np.linalg.inv(poses[rows[0]]) @ poses[padded]
    union = dpm.thin_merged(dpm.merge_clouds(some, jnp.asarray(T_map_scan, jnp.float32)), some.mask.shape[1])
    # Valid rows stand in front: attention over masked ones costs several times as much.
    num_rows = 1 << max(int(union.mask.sum()) - 1, 0).bit_length()
    order = np.argsort(~np.asarray(union.mask), kind="stable")[:num_rows]
    compact: DescriptorCloud = jax.tree.map(lambda leaf: leaf[order], union)
    return compact


def table(rows: list[cli.Row], nums_keyframes: tuple[int, ...]) -> str:
    """Returns the table as Markdown: scans that are wrong, median and 95th percentile of the error, metres."""
    names = [f"{num} merged" if num > 1 else "nearest" for num in nums_keyframes]
    lines = []
    for row in rows:
        cells = (
            f"{one['num_wrong']} ({one['num_over_2_m']} > 2 m), {one['median_error_m']:.2f}, {one['error_95_m']:.2f} m"
            for one in (row[f"keyframes_{num}"] for num in nums_keyframes)
        )
        lines.append([row["sequence"], row["num_scans"], *cells])
    return cli.markdown(("sequence", "scans", *names), lines)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))

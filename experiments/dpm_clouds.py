"""Registers pairs of scans from their descriptor clouds alone, and refines the motion by their surface elements.

    python -m experiments.dpm_clouds path/to/drive another/drive
    python -m experiments.dpm_clouds scenes                             simulated scenes that no training has seen

Random pairs 2 to 10 m and 10 to 20 m apart, turned by any yaw, are encoded; the scans themselves are not used again. A
registration within 2 m and 5 degrees is right. A row of the table has the share of right ones and their median error,
for the decoder alone and after the alignment of N surface elements. The descriptors are the first elements. The last
column has the accuracy of the offset head on close descriptors: coefficient of determination and root mean square
residual along x, y and z of the lidar. Results go to results/dpm_clouds/<time>/: table.md, metrics.json.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import DescriptorCloud, cli, io, load_model, registration_recall, simulation
from dpmjax import deeppointmap as dpm

EXPERIMENT = "dpm_clouds"
# Apart from the seeds of training, selection, calibration and held-out towns.
FIRST_SCENE, NUM_SCENES = 7_000_000, 9
# Numbers of surface elements a scan, one column each.
ELEMENTS = (256, 512, 768, 1024)


@dataclass(frozen=True, kw_only=True)
class Config(cli.ModelOptions, cli.RunOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="scenes|PATH ...")] = ("scenes",)
    """Folders of scans with poses, or simulated scenes."""
    pairs: Annotated[int, arg(metavar="N")] = 20
    """Pairs for each distance."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, pairs=1, seed=0)
        if not self.paths:
            raise ValueError("give at least one folder of scans, or scenes")


def main(config: Config) -> list[cli.Row]:
    """Makes the rows that are missing, and writes the table and the numbers."""
    model = load_model(config.weights)
    low, high = model.config.num_descriptors, model.config.pyramid.stages[0].num_points
    elements = [num for num in ELEMENTS if low <= num <= high]
    if not elements:
        raise ValueError(f"{config.weights}: scans have from {low} to {high} elements, none of {ELEMENTS}")
    drives = {drive.name: drive for drive in open_drives(config.paths)}
    stages = {"decoder": None, **{f"elements_{num}": num for num in elements}}

    def work(_: cli.TableRun, sequence: str, band: str) -> cli.Row:
        drawn = dpm.draw_scan_pairs(drives[sequence], band, config.pairs, seed=config.seed)
        return evaluate(model, dpm.read_scan_pairs(drives[sequence], drawn, seed=config.seed), stages)

    cases = [{"sequence": name, "band": band} for name in drives for band in cli.BAND_NAMES]
    numbers = {"weights": config.weights}
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: cli.Summary(numbers, table(rows, list(stages))))


def open_drives(paths: Sequence[str]) -> list[io.LidarSequence]:
    """Opens the drives, and simulates scenes where a path is scenes; a `ValueError` names one without poses."""
    drives: list[io.LidarSequence] = []
    for path in paths:
        if path == "scenes" and not Path(path).exists():
            seeds = range(FIRST_SCENE, FIRST_SCENE + NUM_SCENES)
            drives += [simulation.simulate_scene(simulation.draw_scene(seed)) for seed in seeds]
            continue
        drives += [io.open_lidar_sequence(path, sequence=name) for name in io.list_lidar_sequences(path) or [None]]
    for drive in drives:
        if drive.T_world_lidar is None:
            raise ValueError(f"{drive.name}: expected a pose for each scan, got none")
    return drives


def evaluate(model: dpm.Model, pairs: Iterable[dpm.ScanPair], stages: dict[str, int | None]) -> cli.Row:
    """Returns errors in metres and seconds by stage, and the quality of the offsets, on the pairs of a band."""
    motions: dict[str, list[np.ndarray]] = {stage: [] for stage in stages}
    seconds: dict[str, list[float]] = {stage: [] for stage in stages}
    encoded = []
    most = max(num for num in stages.values() if num is not None)
    for pair in pairs:
        clouds = [dpm.encode(model, points, num_elements=most) for points in (pair.source, pair.target)]
        encoded.append((*clouds, pair.T_target_source.astype(np.float32)))
        for stage, num in stages.items():
            few = [first_elements(cloud, num) for cloud in clouds]
            start = time.process_time()
            match = dpm.register(model, few[0], few[1], refine=num is not None)
            motions[stage].append(np.asarray(match.T_target_source, np.float64))
            seconds[stage].append(time.process_time() - start)
    row: cli.Row = {"num_pairs": len(encoded)}
    if not encoded:
        return row
    true = np.stack([np.asarray(T, np.float64) for *_, T in encoded])
    for stage in stages:
        found = registration_recall(np.stack(motions[stage]), true)
        errors = np.asarray(found.translation_errors_m)[np.asarray(found.is_right)]
        row[f"recall_{stage}"] = float(found.recall)
        row[f"median_error_{stage}_m"] = float(np.median(errors)) if len(errors) else None
        row[f"{stage}_cpu_s"] = float(np.median(seconds[stage]))
    offsets = dpm.offset_quality(model, encoded)
    return {**row, "offset_r2": offsets.r2.tolist(), "offset_rmse_m": offsets.rmse_m.tolist()}


def first_elements(cloud: DescriptorCloud, num: int | None) -> DescriptorCloud:
    """Returns the cloud with its first elements; None leaves the descriptors without elements."""
    if num is None:
        return cloud.described
    return cloud.replace(**{name: getattr(cloud, name)[:num] for name in ("positions", "mask", "normals", "planarity")})


def table(rows: Sequence[cli.Row], stages: Sequence[str]) -> str:
    """Returns the table as Markdown: recall and median error of the right ones, metres."""
    names = [" ".join(reversed(stage.split("_"))) for stage in stages]
    lines = []
    for row in rows:
        if row["num_pairs"] == 0:
            continue
        cells = (f"{row[f'recall_{stage}']:.2f}, {cli.length_text(row[f'median_error_{stage}_m'])}" for stage in stages)
        # JSON has no NaN: what could not be measured is null in the file of a row.
        parts = zip(row["offset_r2"], row["offset_rmse_m"], strict=True)
        r2 = ", ".join(f"{cli.cell_text(share)} ({cli.cell_text(rmse_m)} m)" for share, rmse_m in parts)
        lines.append([row["sequence"], cli.BAND_NAMES[row["band"]], row["num_pairs"], *cells, r2])
    return cli.markdown(("sequence", "distance", "pairs", *names, "R2 of offsets x, y, z (rmse)"), lines)


if __name__ == "__main__":
    raise SystemExit(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))

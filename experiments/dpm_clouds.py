"""Registers pairs of scans from their descriptor clouds alone, and refines the motion by their surface elements.

    python -m experiments.dpm_clouds path/to/drive another/drive
    python -m experiments.dpm_clouds scenes --num-scenes 9              simulated scenes that no training has seen

Random pairs 2 to 10 m and 10 to 20 m apart, turned by any yaw, are encoded; the scans themselves are not used again. A
registration within 2 m and 5 degrees is right. A row of the table has the share of right ones and their median error,
for the decoder alone and after the alignment of N surface elements. The descriptors are the first elements. The last
column has the accuracy of the offset head on close descriptors: coefficient of determination and root mean square
residual along x, y and z of the lidar. Results go to results/dpm_clouds/<time>/: table.md, metrics.json.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from dpmjax.cli import (
    BAND_NAMES,
    RunFolder,
    RunOptions,
    StopFlag,
    check_least,
    do_rows,
    open_run_folder,
    recording,
    run_command,
    write_metrics,
)

if TYPE_CHECKING:
    from dpmjax import DescriptorCloud
    from dpmjax.deeppointmap import Model
    from dpmjax.io import LidarSequence

EXPERIMENT = "dpm_clouds"
# Apart from the seeds of training, selection, calibration and held-out towns.
FIRST_SCENE = 7_000_000


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="scenes|PATH ...")] = ("scenes",)
    """Folders of scans with poses, or simulated scenes."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file."""
    pairs: Annotated[int, arg(metavar="N")] = 20
    """Pairs for each distance."""
    num_scenes: Annotated[int, arg(metavar="N")] = 9
    """Number of scenes, where scenes is among the paths."""
    elements: Annotated[tuple[int, ...], arg(metavar="N")] = (256, 512, 768, 1024)
    """Numbers of surface elements a scan, one column each."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, pairs=1, num_scenes=1, seed=0, elements=1)
        if not self.paths or not self.elements:
            raise ValueError("give at least one folder of scans, or scenes, and one number of elements")


def main(config: Config) -> list[dict[str, Any]]:
    """Makes the rows that are missing, and writes the table and the numbers."""
    from dpmjax import load_model

    model = load_model(config.weights)
    low, high = model.config.num_descriptors, model.config.pyramid.stages[0].num_points
    if not low <= min(config.elements) <= max(config.elements) <= high:
        raise ValueError(f"--elements: expected from {low} to {high}, got {config.elements}")
    drives = {drive.name: drive for drive in open_drives(config)}
    folder = open_run_folder(config, EXPERIMENT)

    def work(sequence: str, band: str) -> dict[str, Any]:
        return evaluate(model, drives[sequence], band, config)

    with recording(folder), StopFlag() as stop:
        cases = [{"sequence": name, "band": band} for name in drives for band in BAND_NAMES]
        rows = do_rows(folder.path, cases, work, seed=config.seed, is_stopped=lambda: stop.is_requested)
        print(write_results(folder, config, rows))
    print(f"results in {folder.path}")
    return rows


def open_drives(config: Config) -> list[LidarSequence]:
    """Opens the drives; a `ValueError` names one without poses."""
    from dpmjax.io import list_lidar_sequences, open_lidar_sequence
    from dpmjax.simulation import draw_scene, simulate_scene

    drives: list[LidarSequence] = []
    for path in config.paths:
        if path == "scenes" and not Path(path).exists():
            seeds = range(FIRST_SCENE, FIRST_SCENE + config.num_scenes)
            drives += [simulate_scene(draw_scene(seed)) for seed in seeds]
            continue
        drives += [open_lidar_sequence(path, sequence=name) for name in list_lidar_sequences(path) or [None]]
    for drive in drives:
        if drive.T_world_lidar is None:
            raise ValueError(f"{drive.name}: expected a pose for each scan, got none")
    return drives


def evaluate(model: Model, drive: LidarSequence, band: str, config: Config) -> dict[str, Any]:
    """Returns errors in metres and seconds by stage, and the quality of the offsets, on the pairs of a band."""
    from dpmjax import encode, register, registration_recall
    from dpmjax.deeppointmap import draw_scan_pairs, offset_quality, read_scan_pairs

    stages = {"decoder": None, **{f"elements_{num}": num for num in config.elements}}
    motions: dict[str, list[np.ndarray]] = {stage: [] for stage in stages}
    seconds: dict[str, list[float]] = {stage: [] for stage in stages}
    pairs = []
    drawn = draw_scan_pairs(drive, band, config.pairs, seed=config.seed)
    for pair in read_scan_pairs(drive, drawn, seed=config.seed):
        clouds = [encode(model, points, num_elements=max(config.elements)) for points in (pair.source, pair.target)]
        pairs.append((*clouds, pair.T_target_source.astype(np.float32)))
        for stage, num in stages.items():
            few = [first_elements(cloud, num) for cloud in clouds]
            start = time.process_time()
            match = register(model, few[0], few[1], refine=num is not None)
            motions[stage].append(np.asarray(match.T_target_source, np.float64))
            seconds[stage].append(time.process_time() - start)
    row: dict[str, Any] = {"num_pairs": len(pairs)}
    if not pairs:
        return row
    true = np.stack([np.asarray(T, np.float64) for *_, T in pairs])
    for stage in stages:
        found = registration_recall(np.stack(motions[stage]), true)
        errors = np.asarray(found.translation_errors_m)[np.asarray(found.is_right)]
        row[f"recall_{stage}"] = float(found.recall)
        row[f"median_error_{stage}_m"] = float(np.median(errors)) if len(errors) else None
        row[f"{stage}_cpu_s"] = float(np.median(seconds[stage]))
    offsets = offset_quality(model, pairs)
    return {**row, "offset_r2": offsets.r2.tolist(), "offset_rmse_m": offsets.rmse_m.tolist()}


def first_elements(cloud: DescriptorCloud, num: int | None) -> DescriptorCloud:
    """Returns the cloud with its first elements; None leaves the descriptors without elements."""
    if num is None:
        return cloud.described
    assert cloud.normals is not None
    assert cloud.planarity is not None
    return cloud.replace(
        positions=cloud.positions[:num],
        mask=cloud.mask[:num],
        normals=cloud.normals[:num],
        planarity=cloud.planarity[:num],
    )


def write_results(folder: RunFolder, config: Config, rows: Sequence[dict[str, Any]]) -> str:
    """Writes table.md and metrics.json; returns the table."""
    note = write_metrics(folder, {"weights": config.weights}, seed=config.seed, rows=rows)
    text = table(rows, config.elements)
    (folder / "table.md").write_text(text + (f"\n\n{note}.\n" if note else "\n"), encoding="utf-8")
    return text


def table(rows: Sequence[dict[str, Any]], elements: Sequence[int]) -> str:
    """Returns the table as Markdown: recall and median error of the right ones, metres."""
    columns = ["decoder", *(f"elements_{num}" for num in elements)]
    names = ["decoder", *(f"{num} elements" for num in elements)]
    lines = [
        f"| sequence | distance | pairs | {' | '.join(names)} | R2 of offsets x, y, z (rmse) |",
        "|---" * (len(names) + 4) + "|",
    ]
    for row in rows:
        if row["num_pairs"] == 0:
            continue
        cells = []
        for column in columns:
            error = row[f"median_error_{column}_m"]
            cells.append(f"{row[f'recall_{column}']:.2f}, {'' if error is None else f'{error:.3f} m'}")
        # JSON has no NaN: what could not be measured is null in the file of a row.
        numbers = (
            [np.nan if value is None else value for value in row[name]] for name in ("offset_r2", "offset_rmse_m")
        )
        parts = zip(*numbers, strict=True)
        r2 = ", ".join(f"{share:.2f} ({rmse_m:.2f} m)" for share, rmse_m in parts)
        lines.append(
            f"| {row['sequence']} | {BAND_NAMES[row['band']]} | {row['num_pairs']} | {' | '.join(cells)} | {r2} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))

"""Measures how well a DeepPointMap model registers scans, beside other methods on the same pairs.

    python -m experiments.dpm_evaluate path/to/drive another/drive --weights model.safetensors
    python -m experiments.dpm_evaluate town                             towns that no training has seen
    python -m experiments.dpm_evaluate path/to/drive --clouds 256 1024
    python -m experiments.dpm_evaluate --resume                         go on where the last run stopped

A path is any folder of scans with poses (KITTI, KITTI-360, MulRan, plain ...). Random pairs of scans, 2 to 10 m (near)
and 10 to 20 m (middle) apart and turned by any yaw, are registered. A registration within 2 m and 5 degrees is right.
Two more methods see the same pairs: the search and the verification of `register` without the network, and KISS-Matcher
(extra `kiss`). With --clouds, the pairs are registered from their descriptor clouds too, refined by N surface elements
a scan. The scans themselves are not used again.

The file rows.csv has every pair, overlap.csv the overlap probability of each drive. The file table.md has the shares of
right registrations (95 % intervals) and the median errors of right ones. The file pooled.md has all recorded drives
together, and names the methods that differ. The picture reliability.png is that of `dpmjax evaluate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import arg

from dpmjax import cli, encode, load_model, register
from dpmjax import deeppointmap as dpm
from dpmjax.metrics import mcnemar_p_value
from dpmjax.scan import VerificationConfig, choose_motion, measure_scan, refine_motion

# KISS-Matcher's voxels, metres; indoors is where half of the points are nearer than INDOORS_M.
VOXEL_M, INDOOR_VOXEL_M, INDOORS_M = 0.3, 0.2, 5.0
# Real drives whose recall was watched during the training of `dpm_small`: they are no unseen data.
MONITORED = ("kitti_00_drive",)


@dataclass(frozen=True, kw_only=True)
class PairOptions(cli.EvaluateOptions):
    """Options of the run."""

    pairs: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 30
    """Pairs for each distance."""
    clouds: Annotated[tuple[int, ...], arg(metavar="N ...")] = ()
    """Also register descriptor clouds, refined by N surface elements a scan."""
    num_towns: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 3
    """Number of towns, where town is among the data."""


def main(options: PairOptions, run: cli.Run) -> cli.Row:
    """Registers the pairs that are missing, and writes tables, numbers and pictures."""
    model = load_model(options.weights)
    low, high = model.config.num_descriptors, model.config.pyramid.stages[0].num_points
    if not all(low <= num <= high for num in options.clouds):
        raise ValueError(f"--clouds: expected from {low} to {high} elements a scan, got {options.clouds}")
    drives = cli.open_evaluation_drives(options.data, cli.evaluation_towns(options.num_towns))
    no_kiss = cli.why_not_importable("kiss_matcher")
    matchers: dict[str, cli.Matcher] = {"search": partial(search_alone, config=model.config.verification)}
    matchers |= {} if no_kiss else {"kiss": kiss_matcher}
    matchers |= {f"clouds_{num}": partial(match_clouds, model=model, num_elements=num) for num in options.clouds}
    run.open()
    rows = cli.register_pairs(run, model, drives, options, matchers)
    summary = cli.summarize_pairs(rows, cli.fill_overlap(run, model, drives, options), tuple(matchers))
    notes = () if no_kiss is None else (f"KISS-Matcher was not run: {no_kiss}.",)
    numbers = {"weights": options.weights, "kiss_matcher": no_kiss or "run"}
    numbers |= cli.rate_confidence(run, model, rows, Path(options.weights).stem)
    numbers |= cli.write_summary(run, summary, *notes)
    recorded = [drive.name for drive in drives if Path(drive.sources[0]).exists()]
    pooled = pool_drives(rows, recorded or [drive.name for drive in drives])
    shares = tuple(f"{name}_right" for name in (*cli.STAGES, *matchers))
    table = cli.summarize(pooled, ("drives", "band"), shares)
    return numbers | cli.write_summary(run, table, *compare_methods(pooled, shares), name="pooled")


def kiss_matcher(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns `T_target_source` of KISS-Matcher (Lim et al. 2025)."""
    import kiss_matcher

    ranges = np.linalg.norm(np.concatenate([source, target]), axis=1)
    voxel_m = INDOOR_VOXEL_M if np.median(ranges) < INDOORS_M else VOXEL_M
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_m))
    found = matcher.estimate(list(source.astype(np.float32)), list(target.astype(np.float32)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
    return T


def search_alone(source: np.ndarray, target: np.ndarray, config: VerificationConfig) -> np.ndarray:
    """Returns `T_target_source` by the search of `register` among the views from above, without a network."""
    measured = measure_scan(source, config.surface), measure_scan(target, config.surface)
    chosen = choose_motion(*measured, np.eye(4)[None], config)
    return refine_motion(*measured, chosen, config).T_target_source


def match_clouds(source: np.ndarray, target: np.ndarray, *, model: dpm.Model, num_elements: int) -> np.ndarray:
    """Returns `T_target_source` of descriptor clouds, refined by their surface elements."""
    clouds = [encode(model, points, num_elements=num_elements) for points in (source, target)]
    return np.asarray(register(model, *clouds, refine=True).T_target_source, np.float64)


def pool_drives(rows: Sequence[cli.Row], drives: Sequence[str]) -> list[cli.Row]:
    """Returns the pairs of some drives, and again those of drives that were not watched during the training."""
    near = [row for row in rows if row["drive"] in drives and row["band"] != "far"]
    unseen = [row for row in near if row["drive"] not in MONITORED]
    pooled = [row | {"drives": "all"} for row in near]
    title = f"all but {', '.join(MONITORED)}, watched during the training"
    return pooled + ([row | {"drives": title} for row in unseen] if len(unseen) < len(near) else [])


def compare_methods(pooled: Sequence[cli.Row], shares: Sequence[str]) -> list[str]:
    """Returns the p-values of the refined registrations against other methods on the same pairs (McNemar's test)."""
    notes = []
    for drives, band in dict.fromkeys((row["drives"], row["band"]) for row in pooled):
        group = [row for row in pooled if (row["drives"], row["band"]) == (drives, band)]
        answers = {name: np.array([row[name] for row in group]) for name in shares}
        ours = answers.pop("refined_right")
        p_values = (
            f"{name.removesuffix('_right')} {mcnemar_p_value(ours, other):.2g}" for name, other in answers.items()
        )
        notes.append(f"{drives}, {band}: p of refined against {', '.join(p_values)} (McNemar's exact test, two-sided).")
    return notes


if __name__ == "__main__":
    cli.run_experiment(main)

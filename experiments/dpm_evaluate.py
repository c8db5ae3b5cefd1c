"""Measures how well a DeepPointMap model registers scans, and SLAM with it, beside other programs on the same scans.

    python -m experiments.dpm_evaluate path/to/drive another/drive --weights model.safetensors
    python -m experiments.dpm_evaluate town                             towns that no training has seen
    python -m experiments.dpm_evaluate path/to/drive --clouds 256 1024
    python -m experiments.dpm_evaluate --slam path/to/drive another/drive
    python -m experiments.dpm_evaluate --slam town --num-towns 5 --town-length-m 1000 4000
    python -m experiments.dpm_evaluate --slam path/to/drive kitti_00.txt kitti_07.txt      towns along real routes
    python -m experiments.dpm_evaluate --resume                         go on where the last run stopped

A path is any folder of scans with poses (KITTI, KITTI-360, MulRan, plain ...). Random pairs of scans, 2 to 10 m and 10
to 20 m apart and turned by any yaw, are registered. A registration within 2 m and 5 degrees is right. Results go to
results/dpm_evaluate/<time>/: table.md, metrics.json, reliability.png, failures.png (the worst pairs from above). Two
more methods see the same pairs: the search and the verification of `register` without the network, and KISS-Matcher
(extra `kiss`). With --clouds, the pairs are registered from their descriptor clouds too, refined by N surface elements
a scan; the scans themselves are not used again. Rows of all recorded drives together have confidence intervals and say
which methods differ.

With --slam, the whole system and its odometry run beside KISS-ICP, KISS-SLAM and odometry by small_gicp (extra
`peers`). Then random scans are localised in the map of each drive's first half. Poses are needed for the errors only. A
file of poses (TUM or KITTI) stands for a town that is simulated along it; scans are kept in results/simulated. The
file table.md has ATE, KITTI's t_rel, loops, their recall, bytes of maps, localisations and seconds a scan. The seconds
are of all scans, and of the first and the last tenth, which show whether they grow. trajectories.png and map_sizes.png
show the trajectories and the bytes of maps; drives/ holds the trajectories of every method and the files of our run.
`_slam_evaluation.py` says how loops are counted.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, encode, load_model, register, registration_recall, slam
from dpmjax import deeppointmap as dpm
from dpmjax.io import LidarSequence
from dpmjax.metrics import mcnemar_p_value, wilson_interval

EXPERIMENT = "dpm_evaluate"
# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 4
# KISS-Matcher's voxels, metres; indoors is where half of the points are nearer than INDOORS_M.
VOXEL_M, INDOOR_VOXEL_M, INDOORS_M = 0.3, 0.2, 5.0
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]
NETWORK, VERIFIED = "network alone", "network, search and verification"
SEARCH, KISS = "search and verification, no network", "KISS-Matcher"
# Beginning of the names of matches of clouds, before the number of surface elements.
CLOUDS = "clouds, elements "
# The row and its entry that say which pairs a method has registered right.
_ANSWERS = {
    NETWORK: ("DeepPointMap", "is_right_descriptors"),
    VERIFIED: ("DeepPointMap", "is_right"),
    SEARCH: ("search", "is_right"),
    KISS: ("KISS-Matcher", "is_right"),
}
# Real drives whose recall was watched during the training of `dpm_small`: they are no unseen data.
MONITORED = ("kitti_00_drive",)


@dataclass(frozen=True, kw_only=True)
class Config(cli.DriveOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="town|PATH ...")] = ("town",)
    """Folders of scans with poses, files of poses along which a town is simulated, or towns of the seeds."""
    slam: FlagCreatePairsOff[bool] = False
    """Compare SLAM on whole drives instead of registrations of pairs."""
    pairs: Annotated[int, arg(metavar="N")] = 30
    """Pairs for each distance."""
    clouds: Annotated[tuple[int, ...], arg(metavar="N ...")] = ()
    """Also register descriptor clouds, refined by N surface elements a scan."""
    num_towns: Annotated[int, arg(metavar="N")] = 3
    """Number of towns, where town is among the paths."""
    town_length_m: Annotated[tuple[float, ...], arg(metavar="M")] = (400.0,)
    """Length of the towns' routes; two numbers with --slam: from that of the first town to that of the last."""
    no_kiss: FlagCreatePairsOff[bool] = False
    """Leave KISS-Matcher out."""
    localize: Annotated[int, arg(metavar="N")] = 50
    """With --slam: number of scans that are looked for in the map of the first half; 0 leaves it out."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        cli.check_least(self, pairs=1, num_towns=1, localize=0, town_length_m=100)
        if not self.paths:
            raise ValueError("give at least one folder of scans, or town")
        if not 1 <= len(self.town_length_m) <= (2 if self.slam else 1):
            raise ValueError("--town-length-m: expected one length, or two with --slam")
        if not self.slam and (self.n_scans is not None or self.jump != 1 or self.kitti_angle_correction):
            raise ValueError("only with --slam: --n-scans, --jump, --kitti-angle-correction")


def main(config: Config) -> list[cli.Row]:
    """Compares SLAM, or registers pairs."""
    return evaluate_slam(config) if config.slam else evaluate_pairs(config)


def evaluate_slam(config: Config) -> list[cli.Row]:
    """Makes the rows of drives and methods that are missing, and writes tables, numbers and pictures."""
    from experiments import _slam_comparison as comparison

    methods = slam.make_methods(load_model(config.weights), weights=config.weights)
    lengths_m = np.linspace(config.town_length_m[0], config.town_length_m[-1], config.num_towns).tolist()
    drives = comparison.open_drives(config.paths, config, lengths_m)
    return comparison.compare(config, EXPERIMENT, methods, drives, config.localize)


def evaluate_pairs(config: Config) -> list[cli.Row]:
    """Registers the pairs that are missing, and writes table, numbers and pictures."""
    model = load_model(config.weights)
    low, high = model.config.num_descriptors, model.config.pyramid.stages[0].num_points
    if not all(low <= num <= high for num in config.clouds):
        raise ValueError(f"--clouds: expected from {low} to {high} elements a scan, got {config.clouds}")
    matchers = {"search": partial(search_alone, config=model.config.verification), "KISS-Matcher": kiss_matcher}
    matchers |= {f"{CLOUDS}{num}": partial(match_clouds, model=model, num_elements=num) for num in config.clouds}
    drives = cli.open_evaluation_drives(config.paths, cli.evaluation_towns(config.num_towns, config.town_length_m[0]))
    by_name = {drive.name: drive for drive in drives}
    no_kiss = cli.why_not_importable("kiss_matcher") if not config.no_kiss else "left out by --no-kiss"
    methods = ["DeepPointMap", *(name for name in matchers if no_kiss is None or name != "KISS-Matcher")]

    def work(run: cli.TableRun, method: str, sequence: str, band: str) -> cli.Row:
        drive = by_name[sequence]
        if method == "overlap":
            num_pairs = OVERLAP_FACTOR * config.pairs
            return cli.overlap_row(model, drive, num_pairs, seed=config.seed, on_scan=run.check_stop)
        if method == "DeepPointMap":
            return cli.registration_row(model, cli.read_pairs(run, drive, band, config), config.pairs)
        pairs = cli.read_pairs(run, drive, band, config)
        return evaluate_matcher(matchers[method], pairs)

    bands = [(method, band) for band in ("near", "middle") for method in methods]
    cases = [
        {"method": method, "sequence": name, "band": band}
        for name in by_name
        for method, band in (*bands, ("DeepPointMap", "far"), ("overlap", "all"))
    ]
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: report(config, drives, rows, no_kiss))


def report(config: Config, drives: Sequence[LidarSequence], rows: list[cli.Row], no_kiss: str | None) -> cli.Summary:
    """Returns the numbers, the tables and the pictures of the pairs."""
    recorded = [drive.name for drive in drives if Path(drive.sources[0]).exists()]
    pooled = pooled_rows(rows, recorded or [drive.name for drive in drives])
    numbers = {"weights": config.weights, "kiss_matcher": no_kiss or "run", **cli.calibration_numbers(rows)}
    notes = [] if no_kiss is None else [f"KISS-Matcher was not run: {no_kiss}."]
    text = "\n\n".join(filter(None, [table(rows), cloud_tables(rows), pooled_table(pooled), *notes]))
    draw = partial(cli.draw_evaluation, drives=drives, rows=rows, weights=config.weights, seed=config.seed)
    return cli.Summary({**numbers, "pooled": pooled}, text, draw)


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


def search_alone(source: np.ndarray, target: np.ndarray, config: dpm.VerificationConfig) -> np.ndarray:
    """Returns `T_target_source` by the search of `register` among the views from above, without a network."""
    measured = dpm.measure_scan(source, config), dpm.measure_scan(target, config)
    chosen = dpm.choose_motion(*measured, np.eye(4)[None], config)
    return dpm.refine_motion(*measured, chosen, config).T_target_source


def match_clouds(source: np.ndarray, target: np.ndarray, *, model: dpm.Model, num_elements: int) -> np.ndarray:
    """Returns `T_target_source` of descriptor clouds, refined by their surface elements."""
    clouds = [encode(model, points, num_elements=num_elements) for points in (source, target)]
    return np.asarray(register(model, *clouds, refine=True).T_target_source, np.float64)


def evaluate_matcher(matcher: Matcher, pairs: Iterable[dpm.ScanPair]) -> cli.Row:
    """Returns errors and seconds of another matcher on the same pairs."""
    motions, seconds, true = [], [], []
    for pair in pairs:
        started = time.perf_counter()
        motions.append(matcher(pair.source, pair.target))
        seconds.append(time.perf_counter() - started)
        true.append(pair.T_target_source)
    errors = registration_recall(np.reshape(motions, (-1, 4, 4)), np.reshape(true, (-1, 4, 4)))
    row = cli.error_columns(errors, "_refined")
    row["is_right"] = row.pop("is_right_refined")
    return row | ({"pair_s": float(np.median(seconds))} if seconds else {})


def table(rows: Sequence[cli.Row]) -> str:
    """Returns the rows as a Markdown table: one line a sequence and distance."""
    columns = (
        "sequence", "distance", "pairs", f"recall: {NETWORK}", VERIFIED, "the same, refined", f"{SEARCH}, refined",
        KISS, "median error: network alone", "refined", "s / pair", f"{KISS}, s", "overlap AUC",
    )  # fmt: skip
    by_case = {(row["method"], row["sequence"], row["band"]): row for row in rows}
    lines = []
    for (method, sequence, band), row in by_case.items():
        if method != "DeepPointMap" or band not in cli.BAND_NAMES or not row["num_pairs"]:
            continue
        kiss, search = (by_case.get((other, sequence, band), {}) for other in ("KISS-Matcher", "search"))
        auc = by_case.get(("overlap", sequence, "all"), {}).get("auc") if band == "near" else None
        recalls = (row[f"recall_{stage}"] for stage in ("descriptors", "verified", "refined"))
        others = (other.get("recall_refined") for other in (search, kiss))
        errors = (cli.length_text(row[f"median_error_{stage}_m"]) for stage in ("descriptors", "refined"))
        seconds = (row["pair_s"], kiss.get("pair_s"), cli.cell_text(auc, 3))
        lines.append([sequence, cli.BAND_NAMES[band], row["num_pairs"], *recalls, *others, *errors, *seconds])
    return cli.markdown(columns, lines)


def cloud_tables(rows: Sequence[cli.Row]) -> str:
    """Returns the registrations of descriptor clouds as Markdown; without any, an empty string."""
    lines = []
    for row in (row for row in rows if row["method"].startswith(CLOUDS) and row["num_pairs"]):
        errors = (row["recall_refined"], cli.length_text(row["median_error_refined_m"]))
        case = (row["sequence"], cli.BAND_NAMES[row["band"]])
        lines.append([*case, row["method"].removeprefix(CLOUDS), row["num_pairs"], *errors])
    clouds = ("sequence", "distance", "surface elements of clouds", "pairs", "recall", "median error")
    return cli.markdown(clouds, lines) if lines else ""


def pooled_rows(rows: Sequence[Mapping[str, Any]], drives: Sequence[str]) -> list[dict[str, Any]]:
    """Pools the rows of pairs over drives, with and without those that were watched during the training.

    Args:
        rows: rows of `dpm_evaluate`.
        drives: names of the drives to pool.

    Returns:
        One row for each set of drives, band and method that has registered all pairs of the set. `p_values` holds, by
        the name of another method, the p-value of the difference.
    """
    sets = {"all drives": list(drives)}
    unseen = [name for name in drives if name not in MONITORED]
    if len(unseen) < len(drives):
        sets[f"all drives but {', '.join(sorted(set(drives) - set(unseen)))}"] = unseen
    pooled: list[dict[str, Any]] = []
    for (title, names), band in itertools.product(sets.items(), cli.BAND_NAMES):
        answers = {method: _answers(rows, method, names, band) for method in _ANSWERS}
        known = {method: of_all for method, of_all in answers.items() if of_all is not None and len(of_all)}
        for method, is_right in known.items():
            share, low, high = wilson_interval(int(is_right.sum()), len(is_right))
            others = {name: mcnemar_p_value(is_right, other) for name, other in known.items() if name != method}
            numbers = {"num_pairs": len(is_right), "num_right": int(is_right.sum())}
            interval = {"recall": share, "recall_low": low, "recall_high": high}
            case = {"drives": title, "sequences": names, "band": band, "method": method}
            pooled.append({**case, **numbers, **interval, "p_values": others})
    return pooled


def _answers(rows: Sequence[Mapping[str, Any]], method: str, drives: Sequence[str], band: str) -> np.ndarray | None:
    """Returns which pairs of all drives are right; None where the method has not registered those of every drive."""
    name, entry = _ANSWERS[method]
    by_drive = {row["sequence"]: row for row in rows if row["method"] == name and row["band"] == band}
    if any(entry not in by_drive.get(drive, {}) for drive in drives):
        return None
    return np.concatenate([np.zeros(0, bool), *(np.asarray(by_drive[drive][entry], bool) for drive in drives)])


def pooled_table(pooled: Sequence[Mapping[str, Any]]) -> str:
    """Returns the pooled rows as Markdown; without any, an empty string."""
    if not pooled:
        return ""
    lines = []
    for row in pooled:
        p_values = "; ".join(f"{name} {_p_value(p)}" for name, p in row["p_values"].items())
        recall = f"{row['recall']:.3f} ({row['recall_low']:.3f} to {row['recall_high']:.3f})"
        numbers = (row["num_pairs"], row["method"], row["num_right"], recall)
        lines.append([row["drives"], cli.BAND_NAMES[row["band"]], *numbers, p_values or "-"])
    columns = ("pooled over", "distance", "pairs", "method", "right", "recall (95 % interval)")
    text = cli.markdown((*columns, "p against the other methods"), lines)
    notes = "Intervals: Wilson. p: McNemar's exact test, two-sided, on the same pairs."
    notes += " All motions but those of the network alone and of KISS-Matcher are refined."
    if watched := sorted({name for row in pooled for name in row["sequences"]} & set(MONITORED)):
        notes += f" The recall on {', '.join(watched)} was watched during the training: it is no unseen drive."
    return f"{text}\n\n{notes}"


def _p_value(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))

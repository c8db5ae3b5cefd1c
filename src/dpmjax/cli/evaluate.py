"""Measures how well weights of DeepPointMap register the scans of drives whose poses are known.

    dpmjax evaluate                                a simulated suburb that no training has seen
    dpmjax evaluate path/to/drive another/drive    any folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)
    dpmjax evaluate path/to/drive --weights model.safetensors --pairs 100
    dpmjax evaluate --resume                       continue the latest run

Random pairs of scans, 2 to 10 m (near) and 10 to 20 m (middle) apart, are registered, each scan turned by any yaw. A
registration within 2 m and 5 degrees is right. Results go to results/evaluate/<time>/ (latest links to the newest).
The file table.md has the shares of right registrations, with 95 % intervals, and the median errors of right ones. It
has them for the network alone, after the verification by the scans, and after the final alignment. The file rows.csv
has every pair. The picture reliability.png shows the share of right registrations for each confidence, also for pairs
more than 60 m apart (far). The AUC of overlap compares pairs less than 20 m apart (revisits, if the drive has any) with
pairs more than 40 m apart. The file overlap.csv has the AUC of the overlap head on the same pairs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, deeppointmap, metrics, simulation, viz, weights
from dpmjax.sequences import LidarSequence

# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 4
# Seed of the first town; no training, selection or calibration uses these towns.
FIRST_TOWN = 5_000_000
TOWN_LENGTH_M = 400.0
BANDS = ("near", "middle", "far")
STAGES = ("network", "verified", "refined")
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(cli.ModelOptions, cli.RunOptions):
    """Options of the run."""

    data: Annotated[Positional[tuple[str, ...]], arg(metavar="town|PATH ...")] = ("town",)
    """Folders of scans with poses, files of poses along which a town is simulated, or simulated towns."""
    pairs: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 15
    """Pairs for each distance."""
    num_towns: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 1
    """Number of towns, if town is among the data. The first one is a suburb; other kinds of place follow."""

    def __post_init__(self) -> None:
        """Checks bounds, and that there are data."""
        super().__post_init__()
        if not self.data:
            raise ValueError("give at least one folder of scans, or town")


def main(options: EvaluateOptions, run: cli.Run) -> cli.Row:
    """Computes the missing rows, and writes table, numbers and pictures."""
    model = weights.load_model(options.weights)
    kinds = [kind for kind, _ in simulation.SceneMixture().kinds]
    drives = open_evaluation_drives(options.data, evaluation_towns(options.num_towns, kinds))
    run.open()
    rows = register_pairs(run, model, drives, options)
    summary = summarize_pairs(rows, fill_overlap(run, model, drives, options))
    numbers = cli.write_summary(run, summary)
    return {"weights": options.weights, **numbers, **rate_confidence(run, model, rows, Path(options.weights).stem)}


def evaluation_towns(num_towns: int, kinds: Sequence[str | None] = (None,)) -> list[cli.Source]:
    """Returns towns that no training uses, with the kinds of place in turn; None draws one."""
    town = partial(simulation.simulate_drive, length_m=TOWN_LENGTH_M)
    return [partial(town, FIRST_TOWN + number, kind=kinds[number % len(kinds)]) for number in range(num_towns)]


def open_evaluation_drives(data: Sequence[str], towns: Sequence[cli.Source]) -> list[LidarSequence]:
    """Opens the drives of a command line.

    Args:
        data: folders, or `town` for the towns.
        towns: towns from `evaluation_towns`.

    Returns:
        The drives, each with poses and a name of its own.
    """
    print("opening the drives ...", flush=True)
    drives = [source() for source in cli.find_sources(data, towns)]
    cli.check_names_differ(drives)
    return drives


def register_pairs(
    run: cli.Run,
    model: deeppointmap.Model,
    drives: Sequence[LidarSequence],
    options: EvaluateOptions,
    matchers: Mapping[str, Matcher] = MappingProxyType({}),
) -> list[cli.Row]:
    """Fills rows.csv with errors of each pair after each stage, confidence and seconds, also of further methods.

    Args:
        run: the open run.
        model: a trained model.
        drives: drives with poses.
        options: number and seed of the pairs of each drive and band of distances.
        matchers: further methods by name, for pairs that overlap: each makes `T_target_source` of source and target.

    Returns:
        The rows.
    """
    by_name = {drive.name: drive for drive in drives}
    draw = partial(deeppointmap.draw_scan_pairs, num_pairs=options.pairs, seed=options.seed)
    drawn = {(drive.name, band): draw(drive, band) for drive in drives for band in BANDS}
    cases = [
        {"drive": drive, "band": band, "pair": number}
        for (drive, band), pairs in drawn.items()
        for number in range(len(pairs))
    ]

    @lru_cache(maxsize=1)  # the yaws of the pairs of a band come from one stream
    def read(drive: str, band: str) -> list[deeppointmap.ScanPair]:
        return list(deeppointmap.read_scan_pairs(by_name[drive], drawn[drive, band], seed=options.seed))

    def work(drive: str, band: str, pair: int) -> cli.Row:
        scans = read(drive, band)[pair]
        found = deeppointmap.register_in_stages(model, scans)
        row: cli.Row = {"confidence": found.confidence}
        for stage, T in zip(STAGES, (found.descriptors, found.verified, found.refined), strict=True):
            row |= motion_errors(stage, T, scans)
        row["pair_s"] = found.seconds
        for name, matcher in matchers.items() if band != "far" else ():
            begun = time.perf_counter()
            T = matcher(scans.source, scans.target)
            row |= {f"{name}_s": time.perf_counter() - begun, **motion_errors(name, T, scans)}
        return row

    return cli.fill_table(run, cases, work)


def motion_errors(name: str, T_target_source: np.ndarray, pair: deeppointmap.ScanPair) -> cli.Row:
    """Returns the errors of a motion in metres and degrees, and whether it is within 2 m and 5 degrees."""
    found = metrics.registration_recall(T_target_source[None], pair.T_target_source[None])
    return {
        f"{name}_right": bool(found.is_right[0]),
        f"{name}_m": float(found.translation_errors_m[0]),
        f"{name}_deg": float(found.rotation_errors_deg[0]),
    }


def fill_overlap(
    run: cli.Run, model: deeppointmap.Model, drives: Sequence[LidarSequence], options: EvaluateOptions
) -> list[cli.Row]:
    """Fills overlap.csv with AUC and Brier score of the overlap probability of each drive; None without pairs."""
    by_name = {drive.name: drive for drive in drives}

    def work(drive: str) -> cli.Row:
        num_pairs = OVERLAP_FACTOR * options.pairs
        found = deeppointmap.evaluate_overlap(model, by_name[drive], num_pairs, seed=options.seed)
        row: cli.Row = {"num_pairs": len(found.is_overlap), "has_revisits": found.has_revisits}
        for name, probability in (("", found.probability), ("_head", found.by_head)):
            for measure, rate in (("auc", metrics.area_under_curve), ("brier", metrics.brier_score)):
                row[f"{measure}{name}"] = None if probability is None else rate(probability, found.is_overlap)
        return row

    return cli.fill_table(run, [{"drive": name} for name in by_name], work, "overlap.csv")


def summarize_pairs(rows: Sequence[cli.Row], overlap: Sequence[cli.Row], matchers: Sequence[str] = ()) -> list[cli.Row]:
    """Returns the shares of right motions and their median errors, by drive and band, and the AUC."""
    methods, auc = (*STAGES, *matchers), {row["drive"]: row["auc"] for row in overlap}
    rights, errors = ([f"{name}_{kind}" for name in methods] for kind in ("right", "m"))
    near = [
        row | {error: row.get(error) if row.get(right) else None for right, error in zip(rights, errors, strict=True)}
        for row in rows
        if row["band"] != "far"
    ]
    summary = cli.summarize(near, ("drive", "band"), (*rights, *errors, "pair_s", *(f"{name}_s" for name in matchers)))
    return [row | {"overlap_auc": auc.get(row["drive"])} for row in summary]


def rate_confidence(run: cli.Run, model: deeppointmap.Model, rows: Sequence[cli.Row], title: str) -> cli.Row:
    """Returns the Brier score of the confidence and a verdict, and draws reliability.png, for all pairs."""
    if not rows:
        return {"verdict": "no pair is registered"}
    confidence, is_right = (np.array([row[name] for row in rows]) for name in ("confidence", "refined_right"))
    is_near, is_calibrated = np.array([row["band"] != "far" for row in rows]), model.config.calibration is not None
    brier = metrics.brier_score(confidence, is_right)
    verdict = f"{is_right[is_near].sum()} of {is_near.sum()} pairs are registered right; "
    verdict += f"Brier score of the confidence {brier:.3f} (0 is best"
    verdict += ")" if is_calibrated else "; these weights are not calibrated)"
    viz.save_figure(viz.reliability_figure(confidence, is_right, title=f"{title}, all pairs"), run / "reliability.png")
    return {"brier": brier, "is_calibrated": is_calibrated, "verdict": verdict}

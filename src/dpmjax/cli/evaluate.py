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
more than 60 m apart (far). The picture failures.png shows wrong registrations from above. The AUC of overlap compares
pairs less than 20 m apart (revisits, if the drive has any) with pairs more than 40 m apart. The file overlap.csv has
the AUC of the overlap head on the same pairs.
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
OVERLAP_FACTOR = 2
FIRST_TOWN = 5_000_000
"""Seed of the first town; no training, selection or calibration uses these towns."""

NUM_SHOWN, TOWN_LENGTH_M = 4, 400.0
BANDS = ("near", "middle", "far")
STAGES = ("network", "verified", "refined")
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]
COLUMNS = (*(f"{stage}_right" for stage in STAGES), "network_m", "refined_m", "pair_s")


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
    drives = open_evaluation_drives(options.data, evaluation_towns(options.num_towns, TOWN_LENGTH_M, kinds))
    pairs = PairReader(drives, options.pairs, options.seed)
    run.open()
    rows = fill_pairs(run, model, pairs)
    overlap = fill_overlap(run, model, drives, OVERLAP_FACTOR * options.pairs, options.seed)
    summary = summarize_pairs(rows, overlap, STAGES, COLUMNS)
    numbers = {"weights": options.weights, **rate_confidence(model, rows), **cli.write_summary(run, summary)}
    run.write_numbers(numbers)  # also where a picture fails
    draw_evaluation(run, model, pairs, rows, Path(options.weights).stem)
    return numbers


def evaluation_towns(num_towns: int, length_m: float, kinds: Sequence[str | None] = (None,)) -> list[cli.Source]:
    """Returns towns that no training uses, with the kinds of place in turn; None draws one."""
    town = partial(simulation.simulate_drive, length_m=length_m)
    return [partial(town, FIRST_TOWN + number, kind=kinds[number % len(kinds)]) for number in range(num_towns)]


def open_evaluation_drives(data: Sequence[str], towns: Sequence[cli.Source]) -> list[LidarSequence]:
    """Opens the drives of a command line.

    Args:
        data: folders, or `town` for the towns.
        towns: towns from `evaluation_towns`.

    Returns:
        The drives, each with poses, near pairs and a name of its own.

    Raises:
        ValueError: a path cannot be read, or a drive has no poses or no pairs, or two drives have the same name.
    """
    print("opening the drives ...", flush=True)
    drives = [source() for source in cli.find_sources(data, towns)]
    for drive in drives:
        if not len(deeppointmap.draw_scan_pairs(drive, "near", 1)):
            raise ValueError(f"{drive.name}: no two scans are 2 to 10 m apart; are the poses in metres?")
    cli.check_names_differ(drives)
    return drives


class PairReader:
    """Random pairs of scans of several drives. The keys are the drive's name, the band of distances and a number.

    Attributes:
        drawn: numbers of the two scans of each pair, by drive and band.
        cases: drive, band and number of all pairs.
    """

    def __init__(self, drives: Sequence[LidarSequence], num_pairs: int, seed: int) -> None:
        """Draws up to `num_pairs` pairs of each drive and band."""
        draw = partial(deeppointmap.draw_scan_pairs, num_pairs=num_pairs, seed=seed)
        self.drawn = {(drive.name, band): draw(drive, band) for drive in drives for band in BANDS}
        self.cases = [
            {"drive": drive, "band": band, "pair": number}
            for (drive, band), rows in self.drawn.items()
            for number in range(len(rows))
        ]
        by_name = {drive.name: drive for drive in drives}

        def read_band(drive: str, band: str) -> list[deeppointmap.ScanPair]:
            return list(deeppointmap.read_scan_pairs(by_name[drive], self.drawn[drive, band], seed=seed))

        # The yaws of the pairs of a band come from one stream.
        self._read_band = lru_cache(maxsize=1)(read_band)

    def read(self, drive: str, band: str, pair: int) -> deeppointmap.ScanPair:
        """Reads a pair, each scan turned by a random yaw."""
        return self._read_band(drive, band)[pair]


def fill_pairs(
    run: cli.Run, model: deeppointmap.Model, pairs: PairReader, matchers: Mapping[str, Matcher] = MappingProxyType({})
) -> list[cli.Row]:
    """Fills rows.csv with errors of each pair after each stage, confidence and seconds, also of further methods.

    Args:
        run: the open run.
        model: a trained model.
        pairs: pairs of all drives and bands.
        matchers: further methods by name, for pairs that overlap: each makes `T_target_source` of source and target.

    Returns:
        The rows.
    """

    def work(drive: str, band: str, pair: int) -> cli.Row:
        scans = pairs.read(drive, band, pair)
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

    return cli.fill_table(run, pairs.cases, work)


def motion_errors(name: str, T_target_source: np.ndarray, pair: deeppointmap.ScanPair) -> cli.Row:
    """Returns the errors of a motion in metres and degrees, and whether it is within 2 m and 5 degrees."""
    found = metrics.registration_recall(T_target_source[None], pair.T_target_source[None])
    return {
        f"{name}_right": bool(found.is_right[0]),
        f"{name}_m": float(found.translation_errors_m[0]),
        f"{name}_deg": float(found.rotation_errors_deg[0]),
    }


def fill_overlap(
    run: cli.Run, model: deeppointmap.Model, drives: Sequence[LidarSequence], num_pairs: int, seed: int
) -> list[cli.Row]:
    """Fills overlap.csv with AUC and Brier score of the overlap probability of each drive; None without pairs."""
    by_name = {drive.name: drive for drive in drives}

    def work(drive: str) -> cli.Row:
        found = deeppointmap.evaluate_overlap(model, by_name[drive], num_pairs, seed=seed)
        row: cli.Row = {"num_pairs": len(found.is_overlap), "has_revisits": found.has_revisits}
        for name, probability in (("", found.probability), ("_head", found.by_head)):
            for measure, rate in (("auc", metrics.area_under_curve), ("brier", metrics.brier_score)):
                row[f"{measure}{name}"] = None if probability is None else rate(probability, found.is_overlap)
        return row

    return cli.fill_table(run, [{"drive": name} for name in by_name], work, "overlap.csv")


def summarize_pairs(
    rows: Sequence[cli.Row], overlap: Sequence[cli.Row], methods: Sequence[str], columns: Sequence[str]
) -> list[cli.Row]:
    """Returns the shares of right motions and their median errors, by drive and band, and the AUC."""
    auc = {row["drive"]: row["auc"] for row in overlap}
    errors = {f"{name}_m": f"{name}_right" for name in methods}
    of_right = [
        row | {name: row.get(name) if row.get(right) else None for name, right in errors.items()} for row in rows
    ]
    near = [row for row in of_right if row["band"] != "far"]
    return [row | {"overlap_auc": auc.get(row["drive"])} for row in cli.summarize(near, ("drive", "band"), columns)]


def rate_confidence(model: deeppointmap.Model, rows: Sequence[cli.Row]) -> cli.Row:
    """Returns the Brier scores of the confidence for all pairs and for each band, and a verdict."""

    def brier(some: Sequence[cli.Row]) -> float:
        confidence, is_right = (np.array([row[name] for row in some]) for name in ("confidence", "refined_right"))
        return metrics.brier_score(confidence, is_right)

    if not rows:
        return {"verdict": "no pair is registered"}
    near, is_calibrated = [row for row in rows if row["band"] != "far"], model.config.calibration is not None
    bands = {f"brier_{band}": brier(some) for band in BANDS if (some := [row for row in rows if row["band"] == band])}
    right = sum(row["refined_right"] for row in near)
    verdict = f"{right} of {len(near)} pairs are registered right; Brier score of the confidence {brier(rows):.3f}"
    verdict += " (0 is best)" if is_calibrated else " (0 is best; these weights are not calibrated)"
    return {"brier": brier(rows), **bands, "is_calibrated": is_calibrated, "verdict": verdict}


def draw_evaluation(
    run: cli.Run, model: deeppointmap.Model, pairs: PairReader, rows: Sequence[cli.Row], title: str
) -> None:
    """Draws reliability.png and failures.png: wrong registrations of overlapping pairs, with the highest confidence."""
    confidence, is_right = (np.array([row[name] for row in rows]) for name in ("confidence", "refined_right"))
    viz.save_figure(viz.reliability_figure(confidence, is_right, title=f"{title}, all pairs"), run / "reliability.png")
    wrong = [row for row in rows if row["band"] != "far" and not row["refined_right"]]
    shown = []
    for row in sorted(wrong, key=lambda row: -row["confidence"])[:NUM_SHOWN]:
        pair = pairs.read(row["drive"], row["band"], row["pair"])
        a, b = pairs.drawn[row["drive"], row["band"]][row["pair"]]
        title = f"{row['drive']}: scan {a} onto {b}, confidence {row['confidence']:.2f}"
        refined = deeppointmap.register_in_stages(model, pair).refined
        motions = {"estimated motion": refined, "true motion": pair.T_target_source}
        shown.append(viz.RegisteredPair(title, pair.source, pair.target, motions, (f"scan {a}", f"scan {b}")))
    if shown:
        viz.save_figure(viz.registered_pairs_figure(shown), run / "failures.png")

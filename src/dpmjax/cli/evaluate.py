"""Measures how well weights of DeepPointMap register the scans of drives whose poses are known.

    dpmjax evaluate                                a simulated suburb that no training has seen
    dpmjax evaluate path/to/drive another/drive    any folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)
    dpmjax evaluate path/to/drive --weights model.safetensors --pairs 100
    dpmjax evaluate --resume                       continue the latest run

Random pairs of scans, 2 to 10 m and 10 to 20 m apart, are registered, each scan turned by any yaw. A registration
within 2 m and 5 degrees is right. Results go to results/evaluate/<time>/ (latest links to the newest). table.md has the
recall of the network alone, after the verification by the scans, and after the final alignment. metrics.json has every
pair. reliability.png shows the share of right registrations for each confidence, pairs more than 60 m apart included.
failures.png shows wrong registrations from above. The AUC of overlap compares pairs less than 20 m apart (revisits
where the drive has some) with pairs more than 40 m apart; metrics.json has that of the overlap head on the same pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, deeppointmap, metrics, simulation, viz, weights
from dpmjax.sequences import LidarSequence

NAME = "evaluate"
# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 2
FIRST_TOWN = 5_000_000
"""Seed of the first town; no training, selection or calibration uses these towns."""

NUM_SHOWN, TOWN_LENGTH_M = 4, 400.0
STAGES = ("descriptors", "verified", "refined")
BAND_NAMES = {"near": "2-10 m", "middle": "10-20 m"}
COLUMNS = (
    "drive", "distance", "pairs", "recall, network alone", "recall, verified", "recall, refined (95 % interval)",
    "median error, network alone", "median error, refined", "s / pair", "overlap AUC",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Config(cli.ModelOptions, cli.RunOptions):
    """Options of the run."""

    data: Annotated[Positional[tuple[str, ...]], arg(metavar="town|PATH ...")] = ("town",)
    """Folders of scans with poses, or simulated towns."""
    pairs: Annotated[int, arg(metavar="N")] = 15
    """Pairs for each distance."""
    num_towns: Annotated[int, arg(metavar="N")] = 1
    """Number of towns, where town is among the data; a suburb first, then other kinds of place."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, pairs=1, num_towns=1, seed=0)
        if not self.data:
            raise ValueError("give at least one folder of scans, or town")


def main(config: Config) -> list[cli.Row]:
    """Computes the missing rows, and writes table, numbers and pictures."""
    model = weights.load_model(config.weights)
    kinds = [kind for kind, _ in simulation.SceneMixture().kinds]
    drives = open_evaluation_drives(config.data, evaluation_towns(config.num_towns, TOWN_LENGTH_M, kinds))
    by_name = {drive.name: drive for drive in drives}

    def work(run: cli.TableRun, sequence: str, band: str) -> cli.Row:
        drive = by_name[sequence]
        if band == "overlap":
            return overlap_row(model, drive, OVERLAP_FACTOR * config.pairs, seed=config.seed, on_scan=run.check_stop)
        return registration_row(model, read_pairs(run, drive, band, config), config.pairs)

    def report(rows: list[cli.Row]) -> cli.Summary:
        numbers, text = calibration_numbers(rows), table(rows)
        if numbers:
            note = "" if numbers["is_calibrated"] else "; these weights are not calibrated"
            text += f"\n\nBrier score of the confidence, all pairs: {numbers['brier']:.3f} (0 is best{note})."
        draw = partial(draw_evaluation, drives=drives, rows=rows, weights=config.weights, seed=config.seed)
        return cli.Summary({"weights": config.weights, **numbers}, text, draw)

    cases = [{"sequence": name, "band": band} for name in by_name for band in ("near", "middle", "far", "overlap")]
    return cli.run_table(config, NAME, cases, work, report)


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


def read_pairs(run: cli.TableRun, drive: LidarSequence, band: str, config: Any) -> Iterator[deeppointmap.ScanPair]:
    """Yields random pairs of scans of a band of distances; `config` has their number, `pairs`, and the seed."""
    drawn = deeppointmap.draw_scan_pairs(drive, band, config.pairs, seed=config.seed)
    return run.until_stopped(deeppointmap.read_scan_pairs(drive, drawn, seed=config.seed))


def registration_row(model: deeppointmap.Model, pairs: Iterable[deeppointmap.ScanPair], num_asked: int) -> cli.Row:
    """Returns errors by stage, confidence and seconds of the registrations of a band of distances."""
    found = deeppointmap.evaluate_scan_pairs(model, pairs)
    row: cli.Row = {
        "is_calibrated": model.config.calibration is not None,
        "num_asked": num_asked,
        "confidence": found.confidence.tolist(),
    }
    for stage in STAGES:
        row |= error_columns(getattr(found, stage), f"_{stage}")
    row["is_right"] = row.pop("is_right_refined").tolist()
    row["motions"] = found.T_target_source.reshape(-1, 16).tolist()
    if len(found.confidence):
        row["pair_s"] = float(np.median(found.seconds))
    return row


def overlap_row(
    model: deeppointmap.Model, drive: LidarSequence, num_pairs: int, *, seed: int, on_scan: Callable[[], object]
) -> cli.Row:
    """Returns AUC and Brier score of the overlap probability; AUC None where the drive lacks pairs."""
    found = deeppointmap.evaluate_overlap(model, drive, num_pairs, seed=seed, on_scan=on_scan)
    row: cli.Row = {"auc": None, "has_revisits": found.has_revisits, "num_pairs": len(found.is_overlap)}
    if len(found.is_overlap):
        row |= {"auc": found.area_under_curve, "brier": found.brier_score}
        row |= {"probability": found.probability.tolist(), "is_overlap": found.is_overlap.tolist()}
        if found.by_head is not None:
            of_head = found._replace(probability=found.by_head)
            row |= {"auc_head": of_head.area_under_curve, "brier_head": of_head.brier_score}
            row["probability_head"] = found.by_head.tolist()
    return row


def error_columns(errors: metrics.RegistrationRecall, suffix: str) -> cli.Row:
    """Returns the recall, all errors, and the median errors of right registrations."""
    is_right = errors.is_right
    of_right = np.column_stack([errors.translation_errors_m, errors.rotation_errors_deg])[is_right]
    metres, degrees = np.median(of_right, axis=0) if len(of_right) else (np.nan, np.nan)
    return {
        "num_pairs": len(is_right),
        f"recall{suffix}": errors.recall if len(is_right) else None,
        f"median_error{suffix}_m": float(metres),
        f"median_error{suffix}_deg": float(degrees),
        f"translation_errors{suffix}_m": errors.translation_errors_m,
        f"rotation_errors{suffix}_deg": errors.rotation_errors_deg,
        f"is_right{suffix}": is_right,
    }


def calibration_numbers(rows: Sequence[cli.Row]) -> cli.Row:
    """Returns the Brier score of the confidence, over all pairs and those of each band, and `is_calibrated`."""
    known = [row for row in rows if "confidence" in row and row["num_pairs"]]

    def brier(some: Sequence[cli.Row]) -> float:
        confidence, is_right = (np.concatenate([row[name] for row in some]) for name in ("confidence", "is_right"))
        return metrics.brier_score(confidence, is_right.astype(bool))

    numbers = {f"brier_{band}": brier(some) for (band,), some in cli.group_rows(known, "band").items()}
    is_calibrated = all(row["is_calibrated"] for row in known)
    return {"brier": brier(known), **numbers, "is_calibrated": is_calibrated} if known else {}


def draw_evaluation(
    folder: cli.RunFolder, *, drives: Sequence[LidarSequence], rows: Sequence[cli.Row], weights: str, seed: int
) -> None:
    """Draws reliability.png, and failures.png where a registration of an overlapping pair is wrong."""
    known = [row for row in rows if "confidence" in row]
    confidence, is_right = (np.concatenate([[], *(row[name] for row in known)]) for name in ("confidence", "is_right"))
    title = f"{Path(weights).stem}, all pairs"
    viz.save_figure(viz.reliability_figure(confidence, is_right, title=title), folder / "reliability.png")
    if worst := worst_failures(drives, known, seed):
        viz.save_figure(viz.registered_pairs_figure(worst), folder / "failures.png")


def worst_failures(drives: Sequence[LidarSequence], rows: Sequence[cli.Row], seed: int) -> list[viz.RegisteredPair]:
    """Returns the wrong registrations of overlapping pairs that have the highest confidence."""
    names = {drive.name: drive for drive in drives}
    wrong = [
        (row["confidence"][number], row, number)
        for row in rows
        if row["band"] != "far"
        for number in np.flatnonzero(~np.asarray(row["is_right"], bool))
    ]
    shown = []
    for confidence, row, number in sorted(wrong, key=lambda failure: -failure[0])[:NUM_SHOWN]:
        drive = names[row["sequence"]]
        drawn = deeppointmap.draw_scan_pairs(drive, row["band"], row["num_asked"], seed=seed)
        *_, pair = deeppointmap.read_scan_pairs(drive, drawn[: number + 1], seed=seed)
        a, b = drawn[number]
        title = f"{drive.name}: scan {a} onto {b}, confidence {confidence:.2f}"
        motions = {"estimated motion": np.reshape(row["motions"][number], (4, 4)), "true motion": pair.T_target_source}
        shown.append(viz.RegisteredPair(title, pair.source, pair.target, motions, (f"scan {a}", f"scan {b}")))
    return shown


def table(rows: Sequence[cli.Row]) -> str:
    """Returns the table as Markdown: a row for each drive and distance."""
    by_case = {(row["sequence"], row["band"]): row for row in rows}
    lines = []
    for (sequence, band), row in by_case.items():
        if band not in BAND_NAMES or not row["num_pairs"]:
            continue
        auc = by_case.get((sequence, "overlap"), {}).get("auc") if band == "near" else None
        refined = metrics.wilson_interval(int(np.sum(row["is_right"])), row["num_pairs"])
        interval = f"{refined.share:.2f} ({refined.low:.2f} to {refined.high:.2f})"
        recalls = (row[f"recall_{stage}"] for stage in ("descriptors", "verified"))
        errors = (length_text(row[f"median_error_{stage}_m"]) for stage in ("descriptors", "refined"))
        case = (sequence, BAND_NAMES[band], row["num_pairs"])
        lines.append([*case, *recalls, interval, *errors, row["pair_s"], cli.cell_text(auc, 3)])
    return cli.markdown(COLUMNS, lines)


def length_text(metres: float | None) -> str:
    """Returns a median error for a table; a dash where no registration was right."""
    # NaN becomes null in the file of a row.
    return "-" if metres is None or np.isnan(metres) else f"{metres:.3f} m"

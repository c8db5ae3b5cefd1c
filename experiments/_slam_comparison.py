"""`dpm_evaluate --slam`: which drives, the loop over drives and methods, the table and the pictures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax import io, load_model, viz
from dpmjax.cli import DriveSelection, RunFolder, do_row, keep_scans, open_drive, why_not_importable
from dpmjax.io import LidarSequence
from dpmjax.metrics import align_rigid, path_lengths
from dpmjax.simulation import HDL64E, OS1_64, DriveConfig, LidarSensor, Scene, TownConfig, simulate_scene
from dpmjax.slam import SlamMethods, make_methods
from experiments import _slam_evaluation as evaluation
from experiments._slam_evaluation import NETWORK, ODOMETRY, OURS, PRECISIONS, Drive, StoppedError
from experiments._slam_localization import evaluate_localization
from experiments._slam_peers import PEERS, why_missing
from experiments._slam_refine import MULTIWAY, REFINED, evaluate_refinement

TOWN = "town"
# Kind of place, kind of route, lidar: taken in turn. Each route drives some streets in both directions.
TOWNS: tuple[tuple[str, str, LidarSensor], ...] = (
    ("suburb", "there_and_back", HDL64E),
    ("canyon", "wander", OS1_64),
    ("campus", "there_and_back", OS1_64),
    ("suburb", "wander", HDL64E),
    ("car_park", "wander", OS1_64),
)
TOWN_BLOCK_M = 90.0
# A car turns by at most 6 degrees from scan to scan, so that methods that expect a steady motion are not lost.
TOWN_RATE_HZ, TOWN_TURN_DEG_S = 5.0, 30.0
COLORS = {
    "KISS-ICP": "#e08a1e",
    "KISS-SLAM": "#b5432e",
    "small_gicp": "#7a5aa6",
    MULTIWAY: "#8c8c8c",
    ODOMETRY: "#6fa3d8",
    NETWORK: "#e0a030",
    OURS: "#1f4e8c",
    REFINED: "#2e8b57",
}
SIZES = {
    "map_bytes_points": "points of all scans",
    "map_bytes_local_maps": "local maps of KISS-SLAM",
    "map_bytes_voxels": "voxel map of KISS-ICP",
    "map_bytes_gaussians": "Gaussian voxel map of small_gicp",
    "map_bytes_float32": "ours, float32",
    "map_bytes_int8": "ours, int8",
}


Task = tuple[Drive, str, Callable[[], dict[str, Any]]]


@dataclass(frozen=True, kw_only=True)
class DriveChoice:
    """Drives that are compared.

    Attributes:
        paths: folders of scans, files of poses along which towns are simulated, or `TOWN` for towns of the seeds.
        selection: scans of each folder and of each town.
        town_seeds: seeds of the towns.
        town_lengths_m: length of each town's route.
    """

    paths: Sequence[str]
    selection: DriveSelection
    town_seeds: Sequence[int] = ()
    town_lengths_m: Sequence[float] = ()


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Rows that are made of each drive.

    Attributes:
        weights: name of a shipped model, or a file.
        seed: of the refinement and of the scans that are looked for.
        is_refined: whether refinements of our run are rows.
        num_localized: number of scans that are looked for in the map of the first half; 0 for no such row.
    """

    weights: str
    seed: int
    is_refined: bool
    num_localized: int


def open_drives(choice: DriveChoice) -> list[LidarSequence]:
    """Opens the drives; bad input that can be known before the run is a `ValueError`."""
    drives: list[LidarSequence] = []
    part = choice.selection
    for entry in choice.paths:
        if entry == TOWN and not Path(entry).exists():
            towns = zip(choice.town_seeds, choice.town_lengths_m, strict=True)
            simulated = [keep_scans(town_drive(seed, number, length)) for number, (seed, length) in enumerate(towns)]
            rows = slice(None, None, part.jump)
            drives += [drive.take(rows).take(slice(part.num_scans)) for drive in simulated]
        else:
            names: Sequence[str | None] = io.list_lidar_sequences(entry) or [None]
            drives += [open_drive(replace(part, data=Path(entry), sequence=name)) for name in names]
    titles = [drive.name for drive in drives]
    if len(set(titles)) < len(titles):
        raise ValueError(f"two drives have the same name ({', '.join(sorted(titles))}); evaluate them one by one")
    return drives


def town_drive(seed: int, number: int, length_m: float) -> LidarSequence:
    """Returns the drive through a town, once along its route; scans are cast when they are read."""
    kind, route, sensor = TOWNS[number % len(TOWNS)]
    driving = DriveConfig(rate_hz=TOWN_RATE_HZ, sensor_height_m=sensor.height_m, max_turn_deg_s=TOWN_TURN_DEG_S)
    return simulate_scene(Scene(seed, TownConfig(kind, route, length_m, TOWN_BLOCK_M), driving, sensor))


def missing_peers(comparison: Comparison) -> dict[str, str]:
    """Returns the peers that cannot run, and why."""
    reasons = {name: why_missing(name) for name in PEERS}
    if comparison.is_refined:
        reasons[MULTIWAY] = why_not_importable("open3d")
    return {name: reason for name, reason in reasons.items() if reason is not None}


def compare(
    comparison: Comparison, folder: RunFolder, sequences: Sequence[LidarSequence], is_stopped: Callable[[], bool]
) -> Iterator[tuple[Drive, dict[str, Any]]]:
    """Makes the rows that are missing; ends early where a signal came."""
    methods = make_methods(load_model(comparison.weights), weights=comparison.weights)
    missing = missing_peers(comparison)
    drives = [evaluation.open_folder(folder, sequence, is_stopped) for sequence in sequences]
    ours: dict[str, dict[str, Any]] = {}
    # Trajectories of all drives come first: an early end leaves a whole table.
    more = (_refinements(comparison, drives, methods), _localizations(comparison, drives, methods))
    for drive, method, work in itertools.chain(_runs(drives, methods, ours), *more):
        if method in missing:
            continue
        case = {"sequence": drive.sequence.name, "method": method}
        try:
            row = do_row(folder.path, case, work, seed=comparison.seed)
        except StoppedError:
            return
        if method == OURS:
            ours[drive.sequence.name] = row
        yield drive, row


def _runs(drives: Sequence[Drive], methods: SlamMethods, ours: dict[str, dict[str, Any]]) -> Iterator[Task]:
    for drive in drives:
        for name in PEERS:
            yield drive, name, partial(evaluation.evaluate_peer, drive, name)
        yield drive, OURS, partial(evaluation.evaluate_ours, drive, methods)
        yield drive, NETWORK, partial(evaluation.evaluate_network, drive, methods)
        yield drive, ODOMETRY, lambda drive=drive: evaluation.odometry_row(drive, ours[drive.sequence.name])


def _refinements(comparison: Comparison, drives: Sequence[Drive], methods: SlamMethods) -> Iterator[Task]:
    for drive in drives if comparison.is_refined else ():
        for name in (REFINED, MULTIWAY):
            yield drive, name, partial(evaluate_refinement, drive, methods, name, comparison.seed)


def _localizations(comparison: Comparison, drives: Sequence[Drive], methods: SlamMethods) -> Iterator[Task]:
    for drive in drives:
        if comparison.num_localized and drive.reference is not None:
            for precision in PRECISIONS:
                work = partial(evaluate_localization, drive, methods, precision)
                yield drive, f"localization, {precision}", partial(work, comparison.num_localized, comparison.seed)


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the tables as Markdown: trajectories and loops, sizes of maps, localisation."""
    tracks = [row for row in rows if "path_m" in row]
    places = [row for row in rows if "num_inside" in row]
    text = "\n".join(
        [
            "| drive | scans, way | method | ATE, m | t_rel, % | loops (wrong) "
            "| recall of loops: all; same way; opposite | s / scan: all; first, last tenth |",
            "|---|---|---|---|---|---|---|---|",
            *map(_track_line, tracks),
            "",
            f"| drive | way | {' | '.join(f'{name}, MB' for name in SIZES.values())} |",
            "|---" * (2 + len(SIZES)) + "|",
            *map(partial(_size_line, tracks), dict.fromkeys(row["sequence"] for row in tracks)),
        ]
    )
    if not places:
        return text
    lines = [
        "| drive | map of the first half | scans in it: right, not found, wrong | other scans: refused, right, wrong "
        "| median error, m | s / scan |",
        "|---|---|---|---|---|---|",
    ]
    return "\n".join([text, "", *lines, *map(_place_line, places)])


def _track_line(row: dict[str, Any]) -> str:
    loops = f"{row['num_loops']}" + (f" ({row['num_wrong_loops']})" if "num_wrong_loops" in row else "")
    shares = [row.get(f"loop_recall{suffix}") for suffix in ("", "_same_way", "_opposite")]
    recall = "; ".join(number(share) for share in shares) if row.get("num_revisits") else "no scan comes back"
    if "num_known_pairs" in row:
        loops += f", {row['num_known_pairs_found']} of {row['num_known_pairs']} known pairs"
    if row["method"] not in (OURS, NETWORK, "KISS-SLAM"):
        loops = recall = ""
    tenths = row.get("scan_s_tenths")
    growth = f"; {number(tenths[0], 3)}, {number(tenths[-1], 3)}" if tenths else ""
    return (
        f"| {row['sequence']} | {row['num_scans']}, {row['path_m']:.0f} m | {row['method']} "
        f"| {number(row.get('ate_m'), 3)} | {number(row.get('t_rel_percent'))} | {loops} | {recall} "
        f"| {number(row['scan_s'], 3)}{growth} |"
    )


def _size_line(rows: Sequence[dict[str, Any]], sequence: str) -> str:
    of_drive = {row["method"]: row for row in rows if row["sequence"] == sequence}
    merged = {name: row[name] for row in of_drive.values() for name in SIZES if row.get(name)}
    sizes = [merged[name][-1] / 1e6 if name in merged else None for name in SIZES]
    cells = " | ".join(number(size) for size in sizes)
    return f"| {sequence} | {next(iter(of_drive.values()))['path_m']:.0f} m | {cells} |"


def _place_line(row: dict[str, Any]) -> str:
    inside, outside = ([row[f"num_{name}{kind}"] for kind in ("right", "wrong")] for name in ("", "outside_"))
    counts = [
        f"{asked}: {', '.join(map(str, order))}"
        for asked, order in (
            (row["num_inside"], (inside[0], row["num_inside"] - sum(inside), inside[1])),
            (row["num_outside"], (row["num_outside"] - sum(outside), *outside)),
        )
    ]
    return (
        f"| {row['sequence']} | {row['method'].partition(', ')[2]}, {row['map_bytes'] / 1e6:.2f} MB "
        f"| {' | '.join(counts)} | {number(row['median_error_m'], 3)} | {number(row['scan_s'])} |"
    )


def number(value: float | None, decimals: int = 2) -> str:
    """Returns a number for a table; a dash for none."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{decimals}f}"


def draw(folder: RunFolder, drives: Sequence[Drive], rows: Sequence[dict[str, Any]]) -> None:
    """Draws trajectories.png, a panel a drive with all methods, and map_sizes.png, bytes against metres (figure 4)."""
    tracks, sizes = {}, {}
    for drive in drives:
        of_drive = {row["method"]: row for row in rows if row["sequence"] == drive.sequence.name and "path_m" in row}
        tracks[drive.sequence.name] = _panel(drive, of_drive)
        sizes[drive.sequence.name] = _growth(drive, of_drive)
    if tracks:
        viz.save_figure(viz.trajectories_figure(tracks, COLORS), folder / "trajectories.png")
    sizes = {name: curves for name, curves in sizes.items() if curves}
    if sizes:
        viz.save_figure(viz.growth_figure(sizes), folder / "map_sizes.png")


def _panel(drive: Drive, rows: dict[str, dict[str, Any]]) -> viz.TrackPanel:
    """All trajectories in the frame of the reference; without one, in that of the first scan."""
    reference = None if drive.reference is None else drive.reference[:, :3, 3]
    shown = {}
    for method in [name for name in COLORS if name in rows]:
        positions = drive.trajectory(method)[:, :3, 3]
        if reference is not None:
            T = align_rigid(positions, reference)
            positions = positions @ T[:3, :3].T + T[:3, 3]
        shown[method] = positions
    return viz.TrackPanel(shown, reference)


def _growth(drive: Drive, rows: dict[str, dict[str, Any]]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Metres driven, and bytes, of each form of a map."""
    curves = {}
    for row in rows.values():
        poses = drive.trajectory(row["method"]) if drive.reference is None else drive.reference
        for name in [name for name in SIZES if row.get(name)]:
            driven = path_lengths(poses)[np.array(row["map_scans"]) - 1]
            curves[SIZES[name]] = (driven, np.array(row[name], float))
    return {name: curves[name] for name in SIZES.values() if name in curves}

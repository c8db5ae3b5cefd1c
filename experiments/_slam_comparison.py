"""`dpm_evaluate --slam`: the drives, the rows of drives and methods, the tables and the pictures."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from dpmjax import cli, io, load_map, metrics, save_map, slam, viz
from dpmjax.io import LidarSequence
from dpmjax.saved_maps import Precision
from dpmjax.simulation import HDL64E, OS1_64, DriveConfig, Scene, TownConfig, simulate_scene
from experiments import _slam_evaluation as evaluation
from experiments._slam_evaluation import NETWORK, ODOMETRY, OURS, PRECISIONS, Drive, first_keyframes, map_path
from experiments._slam_peers import PEERS

TOWN = "town"
# Kind of place, kind of route, lidar: taken in turn. Each route drives some streets in both directions.
TOWNS = (
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
    ODOMETRY: "#6fa3d8",
    NETWORK: "#2a9d5c",
    OURS: "#1f4e8c",
}
SIZES = {
    "map_bytes_points": "points of all scans",
    "map_bytes_local_maps": "local maps of KISS-SLAM",
    "map_bytes_voxels": "voxel map of KISS-ICP",
    "map_bytes_gaussians": "Gaussian voxel map of small_gicp",
    "map_bytes_float32": "ours, float32",
    "map_bytes_int8": "ours, int8",
}
LOCALIZATION = "localization, "


def open_drives(paths: tuple[str, ...], options: cli.DriveOptions, towns_m: list[float] = ()) -> list[LidarSequence]:
    """Opens the drives that are compared.

    Args:
        paths: folders of scans, files of poses along which towns are simulated, or `TOWN` for towns of the seeds.
        options: selection of the scans of each folder and of each town.
        towns_m: length of the route of each town, metres.

    Returns:
        The drives.

    Raises:
        ValueError: a path cannot be read, or two drives have the same name.
    """
    drives: list[LidarSequence] = []
    for entry in paths:
        if entry == TOWN and not Path(entry).exists():
            simulated = (town_drive(number, length_m) for number, length_m in enumerate(towns_m))
            drives += [cli.keep_scans(drive).take(options.selection) for drive in simulated]
        else:
            names: list[str | None] = io.list_lidar_sequences(entry) or [None]
            drives += [cli.with_reference_only(cli.open_drive(Path(entry), options, name)) for name in names]
    cli.check_names_differ(drives)
    return drives


def town_drive(number: int, length_m: float) -> LidarSequence:
    """Returns the drive through a town, once along its route; scans are cast when they are read."""
    kind, route, sensor = TOWNS[number % len(TOWNS)]
    seed = cli.FIRST_TOWN + number
    driving = DriveConfig(rate_hz=TOWN_RATE_HZ, sensor_height_m=sensor.height_m, max_turn_deg_s=TOWN_TURN_DEG_S)
    return simulate_scene(Scene(seed, TownConfig(kind, route, length_m, TOWN_BLOCK_M), driving, sensor))


def compare(
    config: cli.DriveOptions,
    experiment: str,
    methods: slam.SlamMethods,
    sequences: list[LidarSequence],
    num_localized: int,
) -> list[cli.Row]:
    """Makes the rows of drives and methods that are missing, and writes tables, numbers and pictures."""
    missing = {name: reason for name, (module, _) in PEERS.items() if (reason := cli.why_not_importable(module))}
    by_name = {sequence.name: sequence for sequence in sequences}

    def work(run: cli.TableRun, sequence: str, method: str) -> cli.Row:
        drive = evaluation.open_folder(run, by_name[sequence])
        if method in PEERS:
            return evaluation.evaluate_peer(drive, method)
        if method.startswith(LOCALIZATION):
            precision = next(name for name in PRECISIONS if method.endswith(name))
            return evaluate_localization(drive, methods, precision, num_localized, config.seed)
        if method == NETWORK:
            return evaluation.evaluate_network(drive, methods)
        case, ours = {"sequence": sequence, "method": OURS}, partial(evaluation.evaluate_ours, drive, methods)
        if method == OURS:
            return ours()
        return evaluation.odometry_row(drive, cli.do_row(run.folder.path, case, ours, seed=config.seed))

    def report(rows: list[cli.Row]) -> cli.Summary:
        notes = (f"{name} was not run: {why}." for name, why in missing.items())
        numbers = {"weights": config.weights, "peers_left_out": missing}
        draw_rows = partial(draw, sequences=sequences, rows=rows)
        return cli.Summary(numbers, "\n\n".join([tables(rows), *notes]), draw_rows)

    # Trajectories of all drives come first: an early end leaves a whole table.
    methods_run = [method for method in (*PEERS, OURS, NETWORK, ODOMETRY) if method not in missing]
    cases = [{"sequence": name, "method": method} for name in by_name for method in methods_run]
    cases += [
        {"sequence": sequence.name, "method": f"{LOCALIZATION}{precision}"}
        for sequence in sequences
        for precision in PRECISIONS
        if num_localized and sequence.T_world_lidar is not None
    ]
    return cli.run_table(config, experiment, cases, work, report)


def evaluate_localization(
    drive: Drive, methods: slam.SlamMethods, precision: Precision, num: int, seed: int
) -> cli.Row:
    """Looks for random scans of the drive in the map of its first half, saved and loaded at a precision.

    The map is that of the SLAM run. No scan is one of its keyframes. A scan is in the map where a keyframe of the whole
    first half is near; elsewhere the right answer is that it is not.
    """
    if not map_path(drive.folder.path, "float32").exists():  # no scan had points enough
        return {"num_scans": 0}
    whole = load_map(map_path(drive.folder.path, "float32"))
    num_early = sum(keyframe.scan < len(drive.sequence) / 2 for keyframe in whole.keyframes)
    half = first_keyframes(whole, max(num_early, 1))
    path = save_map(drive.folder / f"first_half_{precision}.npz", half, precision)
    slam_map, taken = load_map(path), {keyframe.scan for keyframe in half.keyframes}
    others = [scan for scan in range(len(drive.sequence)) if scan not in taken]
    chosen = np.sort(np.random.default_rng(seed).choice(others, min(num, len(others)), replace=False))
    part = drive.sequence.take(chosen)
    known = drive.reference[[keyframe.scan for keyframe in slam_map.keyframes]]
    bar = tqdm(range(len(part)), desc=f"{part.name}, {precision}", unit=" scans", dynamic_ncols=True)
    points = (part.read_points(number) for number in drive.run.until_stopped(bar))
    found, clocks = [], [time.perf_counter()]
    for one in slam.localize_each(methods, slam_map, points):
        found.append(one)
        clocks.append(time.perf_counter())
    errors = cli.localization_errors(found, slam_map, known, drive.reference[chosen])
    is_found, is_right = errors.is_found, errors.is_right
    is_inside = errors.keyframe_distance_m <= drive.scale.reach_m
    return {
        "num_scans": len(found),
        "num_keyframes": len(slam_map),
        "map_bytes": path.stat().st_size,
        "num_inside": int(is_inside.sum()),
        "num_right": int((is_inside & is_right).sum()),
        "num_wrong": int((is_inside & is_found & ~is_right).sum()),
        "num_outside": int((~is_inside).sum()),
        "num_outside_right": int((~is_inside & is_right).sum()),
        "num_outside_wrong": int((~is_inside & is_found & ~is_right).sum()),
        "median_error_m": float(np.median(errors.translation_m[is_right])) if is_right.any() else None,
        "scan_s": float(np.median(np.diff(clocks))),
    }


def tables(rows: list[cli.Row]) -> str:
    """Returns the tables as Markdown: trajectories and loops, sizes of maps, localisation."""
    tracks = [row for row in rows if "path_m" in row]
    places = [row for row in rows if "num_inside" in row]
    columns = ("drive", "scans, way", "method", "ATE, m", "t_rel, %", "loops (wrong)")
    columns += ("recall of loops: all; same way; opposite", "s / scan: all; first, last tenth")
    sizes = ("drive", "way", *(f"{name}, MB" for name in SIZES.values()))
    parts = [
        cli.markdown(columns, map(_track_cells, tracks)),
        cli.markdown(sizes, [_size_cells(tracks, name) for name in dict.fromkeys(row["sequence"] for row in tracks)]),
    ]
    if places:
        columns = ("drive", "map of the first half", "scans in it: right, not found, wrong")
        columns += ("other scans: refused, right, wrong", "median error, m", "s / scan")
        parts.append(cli.markdown(columns, map(_place_cells, places)))
    return "\n\n".join(parts)


def _track_cells(row: cli.Row) -> list[object]:
    loops = f"{row['num_loops']}" + (f" ({row['num_wrong_loops']})" if "num_wrong_loops" in row else "")
    shares = [row.get(f"loop_recall{suffix}") for suffix in ("", "_same_way", "_opposite")]
    recall = "; ".join(map(cli.cell_text, shares)) if row.get("num_revisits") else "no scan comes back"
    if row["method"] not in (OURS, NETWORK, "KISS-SLAM"):
        loops = recall = ""
    seconds = cli.cell_text(row["scan_s"], 3)
    if tenths := row.get("scan_s_tenths"):
        seconds += f"; {cli.cell_text(tenths[0], 3)}, {cli.cell_text(tenths[-1], 3)}"
    case = [row["sequence"], f"{row['num_scans']}, {row['path_m']:.0f} m", row["method"]]
    errors = [cli.cell_text(row.get("ate_m"), 3), row.get("t_rel_percent")]
    return [*case, *errors, loops, recall, seconds]


def _size_cells(rows: list[cli.Row], sequence: str) -> list[object]:
    of_drive = {row["method"]: row for row in rows if row["sequence"] == sequence}
    merged = {name: row[name] for row in of_drive.values() for name in SIZES if row.get(name)}
    sizes = (merged[name][-1] / 1e6 if name in merged else None for name in SIZES)
    return [sequence, f"{next(iter(of_drive.values()))['path_m']:.0f} m", *sizes]


def _place_cells(row: cli.Row) -> list[object]:
    right, wrong, outside_right, outside_wrong = (
        row[f"num_{name}"] for name in ("right", "wrong", "outside_right", "outside_wrong")
    )
    inside = (right, row["num_inside"] - right - wrong, wrong)
    outside = (row["num_outside"] - outside_right - outside_wrong, outside_right, outside_wrong)
    counts = [f"{sum(numbers)}: {', '.join(map(str, numbers))}" for numbers in (inside, outside)]
    size = f"{row['method'].removeprefix(LOCALIZATION)}, {row['map_bytes'] / 1e6:.2f} MB"
    return [row["sequence"], size, *counts, cli.cell_text(row["median_error_m"], 3), row["scan_s"]]


def draw(folder: cli.RunFolder, *, sequences: list[LidarSequence], rows: list[cli.Row]) -> None:
    """Draws trajectories.png, a panel a drive with all methods."""
    panels = []
    for sequence in sequences:
        of_drive = {row["method"]: row for row in rows if row["sequence"] == sequence.name and "path_m" in row}
        if of_drive:
            drive = evaluation.open_folder(cli.TableRun(folder, lambda: False), sequence)
            panels.append(_panel(drive, of_drive))
    if panels:
        viz.save_figure(viz.figure(panels), folder / "trajectories.png")


def _panel(drive: Drive, rows: dict[str, cli.Row]) -> viz.Panel:
    """Returns all trajectories in the frame of the reference; without one, in that of the first scan."""
    reference = None if drive.reference is None else drive.reference[:, :3, 3]
    shown = []
    for method in [name for name in COLORS if name in rows]:
        positions = drive.trajectory(method)[:, :3, 3]
        if reference is not None:
            T = metrics.align_rigid(positions, reference)
            positions = positions @ T[:3, :3].T + T[:3, 3]
        shown.append(viz.Track(positions, COLORS[method], method))
    return viz.Panel(drive.sequence.name, shown, reference)

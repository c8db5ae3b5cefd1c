"""Ablations of DeepMapping: those of the paper (supplement A, figures 10 to 13), and two more.

    python -m experiments.deepmapping_ablations --limit 5
    python -m experiments.deepmapping_ablations --only lnet chamfer --steps 300
    python -m experiments.deepmapping_ablations --resume -o out

As in the paper on short walks of a depth camera (here through simulated apartments), from zero: L-Net and M-Net are
trained together. The variants of the networks are lnet (CNN or PointNet) and mnet (MLP or ResMLP, or our grid). Those
of their size are depth (4 to 7 layers of 64) and width (32 to 128 with 4 layers). Those of the loss are chamfer (with
and without) and free (number of free samples a ray). All further settings are fixed. The basis is a small CNN and an
MLP of 6 layers of 64: a run takes half a minute on a CPU. Each run is written to rows/ when it is done; ablations.png
has the box plots.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from tyro.conf import arg

from dpmjax.cli import RunFolder, RunOptions, StopFlag, do_rows, open_run_folder, recording, run_command, write_metrics
from experiments._rgbd_methods import errors_of

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig

EXPERIMENT = "deepmapping_ablations"
_SUCCESS_MM = 450.0
VARIANTS: dict[str, tuple[str, ...]] = {
    "lnet": ("CNN", "PointNet"),
    "mnet": ("MLP", "ResMLP", "grid"),
    "depth": ("4", "5", "6", "7"),
    "width": ("32", "64", "96", "128"),
    "chamfer": ("with", "without"),
    "free": ("1", "4", "12", "35"),
}


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the ablations."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "only"})

    limit: Annotated[int, arg(metavar="N")] = 10
    """Trajectories a variant."""
    steps: Annotated[int, arg(metavar="N")] = 600
    """Steps of each fit."""
    only: tuple[str, ...] = tuple(VARIANTS)
    """Which ablations."""
    views: Annotated[int, arg(metavar="N")] = 8
    """Images a trajectory."""
    points: Annotated[int, arg(metavar="N")] = 200
    """Pixels of each image in a step."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        for name, least in (("limit", 1), ("steps", 1), ("views", 2), ("points", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"--{name}: expected at least {least}, got {getattr(self, name)}")
        unknown = [name for name in self.only if name not in VARIANTS]
        if unknown or not self.only:
            raise ValueError(f"--only: expected some of {', '.join(VARIANTS)}, got {', '.join(unknown) or 'none'}")


def main(config: Config) -> dict[str, Any]:
    """Runs the missing cases, variant by variant, then writes the table and the box plots."""
    folder = open_run_folder(config, EXPERIMENT)
    cases = [
        {"ablation": ablation, "variant": variant, "trajectory": trajectory}
        for ablation in config.only
        for variant in VARIANTS[ablation]
        for trajectory in range(config.limit)
    ]
    with recording(folder), StopFlag() as stop:
        work = partial(run_one, config=config)
        rows = do_rows(folder.path, cases, work, seed=config.seed, is_stopped=lambda: stop.is_requested)
        if rows:
            table = summarise(rows)
            metrics = {"variants": table, "is_interrupted": stop.is_requested}
            write_metrics(folder, metrics, seed=config.seed, rows=rows)
            draw(folder, rows)
            for row in table:
                print(
                    f"{row['ablation']:8} {row['variant']:9} median ATE {row['median_ate_mm']:7.1f} mm, success "
                    f"{100 * row['success']:5.1f} % of {row['num_runs']}, {row['median_run_s']:.1f} s"
                )
            print(f"results in {folder.path}")
            return {"variants": table}
    return {}


def settings_of(ablation: str, variant: str, config: Config) -> DeepMappingConfig:
    """The basis with one thing changed."""
    from dpmjax.deepmapping import JOINT_DEPTH, preset
    from dpmjax.nets import OccupancyConfig

    phase = replace(
        JOINT_DEPTH,
        num_steps=config.steps,
        occupancy_weight=0.5,
        final_learning_rate=0.1,
        beams_per_step=config.points,
        num_free=4,
        is_sampled_as_published=False,
    )
    fast, number = preset("fast", "depth"), int(variant) if variant.isdigit() else 0
    localization = replace(fast.localization, kind="point") if variant == "PointNet" else fast.localization
    maps = {
        "ResMLP": OccupancyConfig(kind="resmlp", features=(64, 64, 64, 128, 128)),
        "grid": fast.occupancy,
        "depth": OccupancyConfig(features=(64,) * number),
        "width": OccupancyConfig(features=(number,) * 4),
    }
    changes: dict[str, dict[str, Any]] = {
        "without": {"occupancy_weight": 1.0},
        "free": {"num_free": number},
    }
    changed = ablation if number else variant
    phase, occupancy = (
        replace(phase, **changes.get(changed, {})),
        maps.get(changed, OccupancyConfig(features=(64,) * 6)),
    )
    per_call = min(50, config.steps)
    networks = {"localization": localization, "occupancy": occupancy}
    return replace(fast, cold_phases=(phase,), warm_phases=(phase,), steps_per_call=per_call, **networks)


def run_one(ablation: str, variant: str, trajectory: int, *, config: Config) -> dict[str, Any]:
    """Errors of one fit; the first of a variant compiles, and its `run_s` contains that."""
    import jax

    from dpmjax import fit_deepmapping, simulation
    from dpmjax.registration_rgbd import as_depth_scans

    seed = 1000 * config.seed + trajectory
    sequence = simulation.simulate_depth_sequence(seed % 15, config.views, seed=seed)
    begun = time.perf_counter()
    scans = as_depth_scans(sequence.points, sequence.mask)
    fitted = fit_deepmapping(scans, settings_of(ablation, variant, config), key=jax.random.key(config.seed))
    return {**errors_of(fitted.T_world_scan, sequence), "run_s": time.perf_counter() - begun}


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row a variant."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {
        (ablation, variant): [row for row in rows if (row["ablation"], row["variant"]) == (ablation, variant)]
        for ablation, variants in VARIANTS.items()
        for variant in variants
    }
    table = []
    for (ablation, variant), some in groups.items():
        if some:
            ate = np.array([row["ate_mm"] for row in some])
            numbers = {"median_ate_mm": np.median(ate), "success": (ate < _SUCCESS_MM).mean()}
            numbers["median_run_s"] = np.median([row["run_s"] for row in some])
            case = {"ablation": ablation, "variant": variant, "num_runs": len(some)}
            quartiles = np.quantile(ate, [0.25, 0.75]).tolist()
            table.append({**case, **{key: float(n) for key, n in numbers.items()}, "quartiles_ate_mm": quartiles})
    return table


def draw(folder: RunFolder, rows: list[dict[str, Any]]) -> None:
    """ablations.png."""
    from dpmjax import viz

    groups: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        groups.setdefault(row["ablation"], {}).setdefault(row["variant"], []).append(row["ate_mm"])
    panels = {f"{ablation}: ATE, mm": variants for ablation, variants in groups.items()}
    viz.save_figure(viz.error_boxes_figure(panels, threshold=_SUCCESS_MM), folder / "ablations.png")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))

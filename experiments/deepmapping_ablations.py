"""Ablations of DeepMapping: those of the paper (supplement A, figures 10 to 13), and two more.

    python -m experiments.deepmapping_ablations --limit 5
    python -m experiments.deepmapping_ablations --only lnet chamfer --steps 300
    python -m experiments.deepmapping_ablations --resume -o out

As in the paper on short walks of a depth camera (here through simulated apartments), from zero: L-Net and M-Net are
trained together. The variants of the networks are lnet (CNN or PointNet) and mnet (MLP or ResMLP, or our grid). Those
of their size are depth (4 to 7 layers of 64) and width (32 to 128 with 4 layers). Those of the loss are chamfer (with
and without) and free (number of free samples a ray). All further settings are fixed. The basis is a small CNN and an
MLP of 6 layers of 64: a run takes half a minute on a CPU. By default each variant has ten trajectories with three seeds
of the networks each: 570 runs, five hours on two cores. Each run is written to rows/ when it is done. The table has 95
% intervals: of the median by a bootstrap over the trajectories, of the success Wilson's of all runs.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from tyro.conf import arg

from dpmjax import cli, metrics, nets, simulation
from dpmjax import deepmapping as dm
from dpmjax.registration_rgbd import as_depth_scans
from experiments.deepmapping_rgbd import errors_of

EXPERIMENT = "deepmapping_ablations"
_SUCCESS_MM = 450.0
# Images of a trajectory, and pixels of each in a step.
_NUM_VIEWS, _NUM_PIXELS = 8, 200
# Samples of the bootstrap.
_NUM_DRAWS = 2000
VARIANTS: dict[str, tuple[str, ...]] = {
    "lnet": ("CNN", "PointNet"),
    "mnet": ("MLP", "ResMLP", "grid"),
    "depth": ("4", "5", "6", "7"),
    "width": ("32", "64", "96", "128"),
    "chamfer": ("with", "without"),
    "free": ("1", "4", "12", "35"),
}


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the ablations."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "seeds", "only"})

    limit: Annotated[int, arg(metavar="N")] = 10
    """Trajectories a variant."""
    seeds: Annotated[int, arg(metavar="N")] = 3
    """Seeds of the networks a trajectory."""
    steps: Annotated[int, arg(metavar="N")] = 600
    """Steps of each fit."""
    only: tuple[str, ...] = tuple(VARIANTS)
    """Which ablations."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, limit=1, seeds=1, steps=1)
        cli.check_names("--only", self.only, VARIANTS)


def main(config: Config) -> list[cli.Row]:
    """Runs the missing cases, trajectory by trajectory, then writes the table and the box plots."""
    cases = [
        {"ablation": ablation, "variant": variant, "trajectory": trajectory, "network_seed": network_seed}
        for network_seed in range(config.seeds)
        for trajectory in range(config.limit)
        for ablation in config.only
        for variant in VARIANTS[ablation]
    ]

    def work(_: cli.TableRun, ablation: str, variant: str, trajectory: int, network_seed: int) -> cli.Row:
        seeds = 1000 * config.seed + trajectory, 1000 * config.seed + network_seed
        return run_one(settings_of(ablation, variant, config.steps), *seeds)

    return cli.run_table(config, EXPERIMENT, cases, work, report)


def settings_of(ablation: str, variant: str, num_steps: int) -> dm.DeepMappingConfig:
    """Returns the basis with one thing changed."""
    fast, number = dm.preset("fast", "depth"), int(variant) if variant.isdigit() else 0
    phase = replace(
        dm.JOINT_DEPTH,
        num_steps=num_steps,
        num_epochs=0,
        occupancy_weight=1.0 if variant == "without" else 0.5,
        final_learning_rate=0.1,
        beams_per_step=_NUM_PIXELS,
        num_free=number if ablation == "free" else 4,
        is_as_published=False,
    )
    localization = replace(fast.localization, kind="point") if variant == "PointNet" else fast.localization
    maps = {
        "ResMLP": nets.OccupancyConfig(kind="resmlp", features=(64, 64, 64, 128, 128)),
        "grid": fast.occupancy,
        "depth": nets.OccupancyConfig(features=(64,) * number),
        "width": nets.OccupancyConfig(features=(number,) * 4),
    }
    occupancy = maps.get(ablation if number else variant, nets.OccupancyConfig(features=(64,) * 6))
    networks = {"localization": localization, "occupancy": occupancy, "steps_per_call": min(50, num_steps)}
    return replace(fast, cold_phases=(phase,), warm_phases=(phase,), **networks)


def run_one(settings: dm.DeepMappingConfig, seed: int, network_seed: int) -> cli.Row:
    """Returns the errors of one fit; the first of a variant compiles, and its `run_s` contains that."""
    import jax

    sequence = simulation.simulate_depth_sequence(seed % 15, _NUM_VIEWS, seed=seed)
    begun = time.perf_counter()
    scans = as_depth_scans(sequence.points, sequence.mask)
    fitted = dm.fit_deepmapping(scans, settings, key=jax.random.key(network_seed))
    return {**errors_of(fitted.T_world_scan, sequence), "run_s": time.perf_counter() - begun}


def report(rows: list[cli.Row]) -> cli.Summary:
    """Returns a line for each variant, with intervals of 95 %."""
    table = []
    for (ablation, variant), some in cli.group_rows(rows, "ablation", "variant").items():
        ate = np.array([row["ate_mm"] for row in some])
        share = metrics.wilson_interval(int((ate < _SUCCESS_MM).sum()), len(ate))
        table.append(
            {
                "ablation": ablation,
                "variant": variant,
                "num_runs": len(some),
                "median_ate_mm": float(np.median(ate)),
                "median_interval_mm": interval_of_median(ate, [row["trajectory"] for row in some]),
                "success": share.share,
                "success_interval": [share.low, share.high],
                "median_run_s": float(np.median([row["run_s"] for row in some])),
                "quartiles_ate_mm": np.quantile(ate, [0.25, 0.75]).tolist(),
            }
        )

    columns = ("ablation", "variant", "runs", "median ATE, mm (95 %)", "success (95 %)", "median s")
    lines = [
        [
            *(row[name] for name in ("ablation", "variant", "num_runs")),
            "{:.0f} ({:.0f} to {:.0f})".format(row["median_ate_mm"], *row["median_interval_mm"]),
            "{:.2f} ({:.2f} to {:.2f})".format(row["success"], *row["success_interval"]),
            f"{row['median_run_s']:.1f}",
        ]
        for row in table
    ]
    return cli.Summary({"variants": table}, cli.markdown(columns, lines))


def interval_of_median(values: np.ndarray, trajectories: list[int]) -> list[float]:
    """Returns the 95 % bootstrap interval of the median; whole trajectories are drawn, since their runs are related."""
    rng, groups = np.random.default_rng(0), [values[np.equal(trajectories, t)] for t in sorted(set(trajectories))]
    draws = rng.integers(len(groups), size=(_NUM_DRAWS, len(groups)))
    medians = [np.median(np.concatenate([groups[k] for k in draw])) for draw in draws]
    return np.quantile(medians, [0.025, 0.975]).tolist()


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))

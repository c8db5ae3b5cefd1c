"""Ablations of DeepMapping: those of the paper (supplement A, figures 10 to 13), and two more.

    python -m experiments.deepmapping_ablations --limit 5
    python -m experiments.deepmapping_ablations --only lnet chamfer --steps 300
    python -m experiments.deepmapping_ablations --resume -o out

As in the paper on short walks of a depth camera (here through simulated apartments), from zero: L-Net and M-Net are
trained together. The variants of the networks are lnet (CNN or PointNet) and mnet (MLP or ResMLP, or our grid). Those
of their size are depth (4 to 7 layers of 64) and width (32 to 128 with 4 layers). Those of the loss are chamfer (with
and without) and free (number of free samples a ray). All further settings are fixed. The basis is a small CNN and an
MLP of 6 layers of 64: a run takes half a minute on a CPU. By default each variant has ten walks with three seeds of the
networks each: 570 runs, five hours on two cores. The file rows.csv has a row for each run, table.md one for each
variant.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import jax
from tyro.conf import arg

from dpmjax import cli, nets, simulation
from dpmjax import deepmapping as dm
from dpmjax.scan import as_depth_scans
from experiments.deepmapping_rgbd import errors_of

# Images of a walk, and pixels of each in a step.
NUM_VIEWS, NUM_PIXELS = 8, 200
VARIANTS: dict[str, tuple[str, ...]] = {
    "lnet": ("CNN", "PointNet"),
    "mnet": ("MLP", "ResMLP", "grid"),
    "depth": ("4", "5", "6", "7"),
    "width": ("32", "64", "96", "128"),
    "chamfer": ("with", "without"),
    "free": ("1", "4", "12", "35"),
}


@dataclass(frozen=True, kw_only=True)
class AblationOptions(cli.RunOptions):
    """Options of the ablations."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "seeds", "only"})

    limit: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 10
    """Walks a variant."""
    seeds: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 3
    """Seeds of the networks a walk."""
    steps: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 600
    """Steps of each fit."""
    only: tuple[str, ...] = tuple(VARIANTS)
    """Which ablations."""

    def __post_init__(self) -> None:
        """Checks bounds and names."""
        super().__post_init__()
        cli.check_names("--only", self.only, VARIANTS)


def main(options: AblationOptions, run: cli.Run) -> cli.Row:
    """Runs the missing cases, walk by walk, and writes the table."""
    run.open()

    def work(ablation: str, variant: str, walk: int, network_seed: int) -> cli.Row:
        seed = 1000 * options.seed + walk
        sequence = simulation.simulate_depth_sequence(seed % 15, NUM_VIEWS, seed=seed)
        settings, begun = settings_of(ablation, variant, options.steps), time.perf_counter()
        scans, key = as_depth_scans(sequence.points, sequence.mask), jax.random.key(1000 * options.seed + network_seed)
        # The first run of a variant compiles.
        fitted = dm.fit_deepmapping(scans, settings, key=key)
        return {**errors_of(fitted.T_world_scan, sequence), "seconds": time.perf_counter() - begun}

    cases = [
        {"ablation": ablation, "variant": variant, "walk": walk, "network_seed": network_seed}
        for network_seed in range(options.seeds)
        for walk in range(options.limit)
        for ablation in options.only
        for variant in VARIANTS[ablation]
    ]
    summary = cli.summarize(
        cli.fill_table(run, cases, work), ("ablation", "variant"), ("success", "ate_m", "point_distance_m", "seconds")
    )
    return cli.write_summary(run, summary)


def settings_of(ablation: str, variant: str, num_steps: int) -> dm.DeepMappingConfig:
    """Returns the basis with one thing changed."""
    fast, number = dm.preset("fast", "depth"), int(variant) if variant.isdigit() else 0
    phase = replace(
        dm.JOINT_DEPTH,
        num_steps=num_steps,
        num_epochs=0,
        occupancy_weight=1.0 if variant == "without" else 0.5,
        final_learning_rate=0.1,
        beams_per_step=NUM_PIXELS,
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


if __name__ == "__main__":
    cli.run_experiment(main)

"""The 75 trajectories of DeepMapping section 4.1, by all methods.

    python -m experiments.deepmapping_suite --limit 6                  the first six trajectories
    python -m experiments.deepmapping_suite --stride 8 --shuffled      every 8th scan, without the order of time
    python -m experiments.deepmapping_suite --resume                   go on where the last run stopped

Three built-in worlds, 50 trajectories of 128 poses and 25 of 256, made by seed. With --range-noise-px the rows also
carry the least error that one scan allows where the world is known (the Cramer-Rao bound). The file rows.csv has a row
for each trajectory and method, table.md a summary. A method that compares several candidates, as a search and
DeepMapping from it, keeps one by the scans alone; its rows name the ATE of each. Success is an ATE below 20 px.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Annotated, ClassVar

import numpy as np
from tyro.conf import FlagCreatePairsOff, arg

from dpmjax import cli, metrics, simulation, slam
from experiments._deepmapping_methods import METHODS, PACKAGES, Task, make_task

NUM_WORLDS, NUM_SHORT, NUM_LONG = 3, 50, 25
# ATE below which the paper calls a run a success (section 4.1).
SUCCESS_PX = 20.0
COLUMNS = ("success", "ate_px", "point_distance_px", "is_best", "seconds", "cpu_s", "is_trusted", "success_if_trusted")


@dataclass(frozen=True, kw_only=True)
class SuiteOptions(cli.RunOptions):
    """Options of the suite."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "methods"})

    methods: tuple[str, ...] = tuple(name for name in METHODS if name not in PACKAGES)
    """Methods to compare; also multiway, swarm-poses and direct-lbfgs (extra `baselines`)."""
    limit: Annotated[int | None, arg(metavar="N"), cli.Bound(1)] = None
    """Only the first N trajectories; they go through worlds and lengths in turn."""
    stride: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 1
    """Use every Nth scan."""
    range_noise_px: Annotated[float, arg(metavar="PX"), cli.Bound(0)] = 0.0
    """Standard deviation of the range noise."""
    shuffled: FlagCreatePairsOff[bool] = False
    """Shuffle the scans: no method knows their order."""
    steps: Annotated[int | None, cli.Bound(2)] = None
    """Steps of the fit; without it, the preset decides."""

    def __post_init__(self) -> None:
        """Checks bounds and names."""
        super().__post_init__()
        cli.check_names("--methods", self.methods, METHODS)


def list_walks() -> list[dict[str, int]]:
    """Returns world, length and seed of all 75, ordered so that the first few are of all kinds."""
    short = [{"world": k % NUM_WORLDS, "num_poses": 128, "walk": k} for k in range(NUM_SHORT)]
    long = [{"world": k % NUM_WORLDS, "num_poses": 256, "walk": 100 + k} for k in range(NUM_LONG)]
    # Two short ones, then a long one.
    return [entry for k in range(NUM_LONG) for entry in (short[2 * k], short[2 * k + 1], long[k])]


def main(options: SuiteOptions, run: cli.Run) -> cli.Row:
    """Runs the missing cases, and writes the table."""
    for name in set(options.methods) & set(PACKAGES):
        cli.require_importable(PACKAGES[name], f"--methods {name}")
    run.open()
    prepare = lru_cache(maxsize=1)(partial(prepare_walk, options))

    def work(world: int, num_poses: int, walk: int, method: str) -> cli.Row:
        task, bound_px = prepare(world, num_poses, walk)
        return run_method(method, task) | {"bound_px": bound_px}

    cases = [{**walk, "method": name} for walk in list_walks()[: options.limit] for name in options.methods]
    rows = cli.fill_table(run, cases, work)
    columns = COLUMNS if options.range_noise_px == 0 else (*COLUMNS, "bound_px")
    return cli.write_summary(run, cli.summarize(rows, ("method",), columns))


def prepare_walk(options: SuiteOptions, world: int, num_poses: int, walk: int) -> tuple[Task, float | None]:
    """Returns the scans of a trajectory, and with noise the Cramer-Rao bound on their ATE, px."""
    noise = options.range_noise_px
    sequence = simulation.simulate_sequence(world, num_poses, seed=walk, range_noise_px=noise)
    sequence = sequence.take(slice(None, None, options.stride))
    task = make_task(sequence, is_ordered=not options.shuffled, steps=options.steps, seed=options.seed)
    if not noise:
        return task, None
    cast = partial(simulation.cast_scans, simulation.make_world(world).is_obstacle, num_beams=sequence.mask.shape[1])
    bound = metrics.position_bound(cast, sequence.reference_poses, range_noise=noise)
    return task, float(np.sqrt(np.mean(bound**2)))


def run_method(name: str, task: Task) -> cli.Row:
    """Returns one row: errors, seconds and trust of the kept candidate, and the ATE of every candidate."""
    begun, begun_cpu = time.perf_counter(), time.process_time()
    found = METHODS[name](task)
    candidates = found if isinstance(found, dict) else {name: found}
    # The choice belongs to a method that has several candidates, and to its time.
    kept = next(iter(candidates))
    if len(candidates) > 1:
        kept, _ = slam.choose_trajectory(task.planar, candidates)
    seconds = {"seconds": time.perf_counter() - begun, "cpu_s": time.process_time() - begun_cpu}
    errors = {other: metrics.planar_errors(task.sequence, poses) for other, poses in candidates.items()}
    ates = {other: numbers["ate_px"] for other, numbers in errors.items()}
    success = ates[kept] < SUCCESS_PX
    is_trusted = slam.assess_trajectory(task.planar, candidates[kept]).is_trusted
    return {
        **errors[kept],
        "success": success,
        **seconds,
        "is_trusted": is_trusted,
        "success_if_trusted": success if is_trusted else None,
        "kept": kept,
        # By no more than 0.1 px above the least ATE of the candidates.
        "is_best": ates[kept] <= min(ates.values()) + 0.1,
        "candidates": "; ".join(f"{other} {ate:.4g} px" for other, ate in ates.items()),
    }


if __name__ == "__main__":
    cli.run_experiment(main)

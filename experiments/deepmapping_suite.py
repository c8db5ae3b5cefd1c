"""The 75 trajectories of DeepMapping section 4.1, by all methods: one table, and the boxes of figure 6.

    python -m experiments.deepmapping_suite --limit 6        the first six trajectories
    python -m experiments.deepmapping_suite --resume         go on where the last run stopped

Three built-in worlds, 50 trajectories of 128 poses and 25 of 256, made by seed. With --range-noise-px the rows also
carry the least error that one scan allows where the world is known (the Cramer-Rao bound). A method that compares
several candidates, as a search and DeepMapping from it, has a row for each of them below its own. Results: table.md,
metrics.json (with all rows).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
from tyro.conf import arg

from dpmjax import cli, metrics, simulation
from experiments import _deepmapping_methods as shared
from experiments._deepmapping_methods import Task

EXPERIMENT = "deepmapping_suite"
NUM_WORLDS, NUM_SHORT, NUM_LONG = 3, 50, 25


@dataclass(frozen=True, kw_only=True)
class Config(shared.TableOptions):
    """Options of the suite."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "walks", "methods"})

    limit: Annotated[int | None, arg(metavar="N")] = None
    """Only the first N trajectories; they go through worlds and lengths in turn."""
    walks: tuple[int, ...] = ()
    """Only the trajectories of these numbers: 0 to 49 of 128 poses, 100 to 124 of 256; without it, all."""
    range_noise_px: Annotated[float, arg(metavar="PX")] = 0.0
    """Standard deviation of the range noise."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        super().__post_init__()
        cli.check_least(self, limit=1, range_noise_px=0)
        known = [entry["walk"] for entry in list_trajectories()]
        if unknown := set(self.walks) - set(known):
            raise ValueError(f"--walks: expected some of 0 to {NUM_SHORT - 1} and 100 to {max(known)}, got {unknown}")


def list_trajectories() -> list[dict[str, int]]:
    """Returns world, length and seed of all 75, ordered so that the first few are of all kinds."""
    short = [{"world": k % NUM_WORLDS, "num_scans": 128, "walk": k} for k in range(NUM_SHORT)]
    long = [{"world": k % NUM_WORLDS, "num_scans": 256, "walk": 100 + k} for k in range(NUM_LONG)]
    # Two short ones, then a long one.
    return [entry for k in range(NUM_LONG) for entry in (short[2 * k], short[2 * k + 1], long[k])]


def main(config: Config) -> list[cli.Row]:
    """Runs the missing cases, and writes the table."""
    chosen = [entry for entry in list_trajectories() if not config.walks or entry["walk"] in config.walks]
    cells = chosen[: config.limit]
    return shared.run_methods(config, EXPERIMENT, cells, partial(_prepare, config), report)


def _prepare(config: Config, cell: cli.Row) -> tuple[Task, cli.Row]:
    """Returns the scans of a trajectory, and with noise the Cramer-Rao bound on their ATE."""
    world, noise = cell["world"], config.range_noise_px
    sequence = simulation.simulate_sequence(world, cell["num_scans"], seed=cell["walk"], range_noise_px=noise)
    task = shared.make_task(sequence, steps=config.steps, seed=config.seed)
    if not noise:
        return task, {}
    cast = partial(simulation.cast_scans, simulation.make_world(world).is_obstacle, num_beams=sequence.mask.shape[1])
    bound = metrics.position_bound(cast, sequence.reference_poses, range_noise=noise)
    return task, {"bound_px": float(np.sqrt(np.mean(bound**2)))}


def summarise(rows: list[cli.Row]) -> cli.Row:
    """Returns medians and success of one method and of each of its candidates, and how right its assessment was."""
    names = dict.fromkeys(name for row in rows for name in row["candidates"])
    medians = {"median_s": "seconds", "median_cpu_s": "cpu_s", "median_bound_px": "bound_px"}
    return {
        **_medians(rows),
        **{name: float(np.median([row[key] for row in rows])) for name, key in medians.items() if key in rows[0]},
        **shared.success_of_trusted(rows),
        "candidates": {
            name: {
                **_medians([row["candidates"][name] for row in rows if name in row["candidates"]]),
                "num_kept": sum(row["kept"] == name for row in rows),
            }
            for name in names
        },
    }


def _medians(numbers: list[cli.Row]) -> cli.Row:
    ates = np.array([row["ate_px"] for row in numbers])
    return {
        "num_trajectories": len(numbers),
        "median_ate_px": float(np.median(ates)),
        "median_point_distance_px": float(np.median([row["point_distance_px"] for row in numbers])),
        "success": float(np.mean(ates < shared.SUCCESS_PX)),
    }


def table(rows: list[cli.Row]) -> str:
    """Returns the table as Markdown: a row for each method, and below it one for each of several candidates."""
    columns = ("method", "trajectories", "median ATE, px", "median point distance, px", "success (ATE < 20 px)")

    def cells(title: str, s: cli.Row, *last: object) -> list[object]:
        medians = (f"{s[name]:.3g}" for name in ("median_ate_px", "median_point_distance_px"))
        return [title, s["num_trajectories"], *medians, f"{s['success']:.1%}", *last]

    lines = []
    for (method,), mine in cli.group_rows(rows, "method").items():
        s = summarise(mine)
        right = "-" if s["success_of_trusted"] is None else f"{s['success_of_trusted']:.1%}"
        lines.append(cells(shared.METHODS[method].title, s, f"{s['median_s']:.1f}", s["num_trusted"], right))
        if len(s["candidates"]) > 1:
            lines += [
                cells(f"- of it: {name}", c, f"kept {c['num_kept']} times", "", "")
                for name, c in s["candidates"].items()
            ]
    return cli.markdown((*columns, "median s", "trusted", "of these right"), lines)


def report(rows: list[cli.Row], not_run: dict[str, str]) -> cli.Summary:
    """Returns the numbers of the methods, and the table."""
    groups = {method: mine for (method,), mine in cli.group_rows(rows, "method").items()}
    methods = {method: {"title": shared.METHODS[method].title, **summarise(mine)} for method, mine in groups.items()}
    text, bounds = table(rows), [row["bound_px"] for row in rows if "bound_px" in row]
    if bounds:
        least = f"{np.median(bounds):.3g} px"
        text += f"\n\nNo unbiased estimate has a median ATE below {least}, not even where the world is known."
    numbers = {"success_threshold_px": shared.SUCCESS_PX, "methods": methods, "not_run": not_run}
    return cli.Summary(numbers, text)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))

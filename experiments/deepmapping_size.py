"""Time and memory of DeepMapping against the number of scans, 64 to 4,096, each size in a process of its own.

    python -m experiments.deepmapping_size
    python -m experiments.deepmapping_size --sizes 64 256 1024 -o out

Steps take at most 256 scans in windows of 32 neighbours in time and every fourth beam, so that M-Net sees a random part
of the rays. A step costs the same for any number of scans, and an epoch (every scan seen once) grows linearly. The
report has both, the peak of memory, and the exponents; size.png draws them.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpmjax.cli import (
    RunOptions,
    environment,
    load_json,
    open_run_folder,
    peak_rss_gb,
    recording,
    run_command,
    write_json,
    write_metrics,
)

EXPERIMENT = "deepmapping_size"
# The exponent is that of large sizes: below, a step does not hold its full number of scans.
_FULL_STEP = 256
# Calls of 25 steps of each phase; the quickest counts.
_NUM_CALLS = 3


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the measurement."""

    may_change: ClassVar[frozenset[str]] = frozenset({"sizes"})

    sizes: tuple[int, ...] = (64, 128, 256, 512, 1024, 2048, 4096)
    """Numbers of scans."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        if not self.sizes or min(self.sizes) < 2:
            raise ValueError(f"--sizes: expected numbers of at least 2, got {self.sizes}")


def main(config: Config) -> dict[str, Any]:
    """Measures the missing sizes, fits the exponents, draws."""
    folder = open_run_folder(config, EXPERIMENT)
    with recording(folder):
        rows = []
        for size in sorted(config.sizes):
            file = folder / f"size_{size}.json"
            if not (folder.is_resumed and file.exists()):
                code = f"from experiments.deepmapping_size import measure; measure({size}, {config.seed},"
                command = [sys.executable, "-c", f"{code} {str(file.resolve())!r})"]
                subprocess.run(command, check=True, cwd=Path(__file__).parents[1])
            rows.append(load_json(file))
            tell(rows[-1])
        metrics = {"rows": [{key: row[key] for key in _KEYS} for row in rows], "exponents": exponents(rows)}
        write_metrics(folder, metrics, seed=config.seed)
        from dpmjax import viz

        viz.save_figure(viz.size_figure(curves(rows), memory_limit_gb=4.0), folder / "size.png")
        print(", ".join(f"{name}: n^{value:.2f}" for name, value in metrics["exponents"].items() if value is not None))
        print(f"results in {folder.path}")
    return metrics


_KEYS = ("num_scans", "network", "free", "data_gb", "peak_rss_gb")


def curves(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Series of the picture and of the fit, by name."""
    columns = {
        f"{title}, {net} (s)": np.array([row[phase][f"{title}_s"] for row in rows])
        for title in ("step", "epoch")
        for net, phase in (("L-Net", "network"), ("free poses", "free"))
    }
    sizes, memory = (np.array([row[key] for row in rows], np.float64) for key in ("num_scans", "peak_rss_gb"))
    return {"num_scans": sizes, **columns, "peak memory (GB)": memory}


def exponents(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """Slopes in the log-log plane from the size on at which a step is full; None with fewer than two such sizes."""
    columns = curves(rows)
    sizes = columns.pop("num_scans")
    is_full = sizes >= _FULL_STEP
    if is_full.sum() < 2:
        return dict.fromkeys(columns)
    return {
        name: float(np.polyfit(np.log(sizes[is_full]), np.log(values[is_full]), 1)[0])
        for name, values in columns.items()
    }


def measure(num_scans: int, seed: int, output: str) -> None:
    """Seconds a step of both phases, and the peak of memory of this process, as JSON."""
    import jax

    from dpmjax import ScanSet
    from dpmjax.deepmapping import fit, mapping_data, mapping_problem, preset, steps_per_call
    from dpmjax.simulation import simulate_sequence

    sequence = simulate_sequence(0, num_scans, seed=seed, with_odometry=True)
    before_gb = peak_rss_gb()
    scans = ScanSet(sequence.points, sequence.mask)
    assert sequence.odometry_poses is not None
    phases: dict[str, Any] = {}
    for name, odometry in (("network", None), ("free", sequence.odometry_poses)):
        data, _ = mapping_data(scans, odometry)
        problem = mapping_problem(preset("fast"), data)
        run_s = [0.0]
        done = fit(
            problem,
            data,
            key=jax.random.key(seed),
            on_report=lambda progress, run_s=run_s: run_s.append(progress.run_s),
            stop=lambda run_s=run_s: len(run_s) > _NUM_CALLS,
        )
        if not np.isfinite(np.asarray(done.poses)).all():
            raise RuntimeError(f"poses of {num_scans} scans are not finite")
        phase = problem.phases[0]
        step_s = float(np.diff(run_s).min()) / steps_per_call(problem, phase)
        # All windows are in each step.
        num_in_step = len(sequence) if phase.scans_per_window else min(len(sequence), phase.scans_per_step)
        epoch_s = step_s * len(sequence) / num_in_step
        phases[name] = {"compile_s": done.compile_s, "step_s": step_s, "epoch_s": epoch_s}
    result = {"num_scans": len(sequence), **phases, "data_gb": before_gb, "peak_rss_gb": peak_rss_gb(), **environment()}
    write_json(Path(output), result)


def tell(row: dict[str, Any]) -> None:
    """One line a size."""
    print(
        f"{row['num_scans']:5d} scans: step {1e3 * row['network']['step_s']:.1f} ms (L-Net), "
        f"{1e3 * row['free']['step_s']:.1f} ms (free poses); epoch {row['network']['epoch_s']:.2f} s, "
        f"{row['free']['epoch_s']:.2f} s; peak {row['peak_rss_gb']:.2f} GB",
        flush=True,
    )


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))

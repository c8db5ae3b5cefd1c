"""Measures DeepMapping on N scans in this process, so that its memory is its own. `deepmapping_size` starts it."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments._json import write_json
from experiments._machine import environment, peak_rss_gb


def main(num_scans: str, num_calls: str, seed: str, output: str) -> None:
    """Seconds a step of both phases, and the peak of memory, as JSON."""
    import jax

    from dpmjax import deepmapping as dm
    from dpmjax.deepmapping.stepping import steps_per_call
    from dpmjax.simulation import simulate_sequence
    from dpmjax.types import ScanSet

    sequence = simulate_sequence(0, int(num_scans), seed=int(seed), with_odometry=True)
    before_gb = peak_rss_gb()
    config, key = dm.preset("fast"), jax.random.key(int(seed))
    scans = dm.as_scan_set(ScanSet(sequence.points, sequence.mask))
    reach = dm.measure_reach(scans)
    scans = replace(scans, points=scans.points / reach)
    assert sequence.odometry_poses is not None
    odometry = sequence.odometry_poses / [reach, reach, 1.0]
    phases: dict[str, Any] = {}
    for name, start in (("network", None), ("free", odometry)):
        state = dm.init(key, scans, config, start_poses=start)
        phase = config.phases(is_warm=start is not None)[0]
        begun = time.perf_counter()
        step = dm.make_step(scans, config, phase).lower(state, key=key).compile()
        compile_s, seconds = time.perf_counter() - begun, []
        for _ in range(int(num_calls)):
            begun = time.perf_counter()
            state, report = step(state, key=key)
            jax.block_until_ready(report.poses)
            seconds.append((time.perf_counter() - begun) / steps_per_call(config, phase))
        if not np.isfinite(np.asarray(report.poses)).all():
            raise RuntimeError(f"poses of {num_scans} scans are not finite")
        per_step = float(np.min(seconds))
        scans_per_step = min(len(sequence), phase.scans_per_step)
        phases[name] = {
            "compile_s": compile_s,
            "step_s": per_step,
            "epoch_s": per_step * len(sequence) / scans_per_step,
        }
    result = {"num_scans": len(sequence), **phases, "data_gb": before_gb, "peak_rss_gb": peak_rss_gb(), **environment()}
    write_json(Path(output), result)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Statistics of simulated scenes beside those of real scans: does the simulation look like the world?

    python -m experiments.town_statistics                        kinds of place, and the mixture of training
    python -m experiments.town_statistics kitti mulran/KAIST03   beside sequences of real scans

A row is the mean over scans, preprocessed as in training: points; shares of points beyond 20 m, below -1.4 m and above
1 m in the frame of the lidar; shares of neighbourhoods that are lines, planes and volumes. Then, for each real
sequence: the distance (total variation, 0 to 1) of its histograms of range, height and shape from those of the whole
mixture, of the nearest scene, and of the nearest other real sequence.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax.cli import run_command
from dpmjax.io import LidarSequence, list_lidar_sequences, open_lidar_sequence
from dpmjax.simulation import SceneMixture, simulate_drive
from experiments._scan_statistics import (
    HISTOGRAMS,
    ScanStatistics,
    histogram_distance,
    mean_statistics,
    scan_statistics,
)

EXPERIMENT = "town_statistics"
# Far from the seeds of training and of held-out towns.
_FIRST_SEED = 2_000_000
_NUMBERS = ("points", "far", "low", "high", "linear", "planar", "volumetric")


@dataclass(frozen=True)
class Config:
    """Options of the table."""

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="[PATH ...]")] = ()
    """Folders of real scans."""
    scenes: Annotated[int, arg(metavar="N")] = 4
    """Scenes of each kind of place."""
    scans: Annotated[int, arg(metavar="N")] = 8
    """Scans of each scene, and three times as many of each real sequence, evenly spaced."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the scenes."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        for name, least in (("scenes", 1), ("scans", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"--{name}: expected at least {least}, got {getattr(self, name)}")


def main(config: Config) -> dict[str, dict[str, float]]:
    """Prints the tables.

    Returns:
        For each real sequence the distances of its histograms from those of the mixture.
    """
    sequences = [
        open_lidar_sequence(path, sequence=name)
        for path in config.data
        for name in (list_lidar_sequences(path) or [None])
    ]
    real = {sequence.name: scan_statistics(evenly(sequence, 3 * config.scans)) for sequence in sequences}
    scenes = simulated(config)
    by_kind = {kind: mean_statistics([scenes[name] for name in scenes if name[0] == kind]) for kind, _ in scenes}
    weights = dict(SceneMixture().kinds)
    mixture = mean_statistics(list(by_kind.values()), [weights[kind] for kind in by_kind])
    print(f"{'':24s}" + "".join(f"{name:>11s}" for name in _NUMBERS))
    for name, row in {**by_kind, "mixture": mixture, **real}.items():
        print(f"{name:24s}{row.points:11.0f}" + "".join(f"{getattr(row, key):11.2f}" for key in _NUMBERS[1:]))
    if real:
        print(f"\n{'distance from the mixture':32s}" + "".join(f"{name:>11s}" for name in (*HISTOGRAMS, "mean")))
    for name, row in real.items():
        distances = histogram_distance(row, mixture)
        values = [*distances.values(), np.mean(list(distances.values()))]
        nearest, scene = min((_mean_distance(row, scenes[key]), key) for key in scenes)
        others = [_mean_distance(row, other) for key, other in real.items() if key != name]
        among = f", nearest other sequence {min(others):.2f}" if others else ""
        print(
            f"{name:32s}"
            + "".join(f"{value:11.2f}" for value in values)
            + f"  nearest scene {nearest:.2f} ({scene[0]}){among}"
        )
    return {name: histogram_distance(row, mixture) for name, row in real.items()}


def _mean_distance(a: ScanStatistics, b: ScanStatistics) -> float:
    return float(np.mean(list(histogram_distance(a, b).values())))


def evenly(sequence: LidarSequence, count: int) -> Iterator[np.ndarray]:
    """Some scans of a sequence, evenly spaced."""
    numbers = np.unique(np.linspace(0, len(sequence) - 1, min(count, len(sequence))).round().astype(int))
    return (sequence.read_scan(int(number)) for number in numbers)


def simulated(config: Config) -> dict[tuple[str, int], ScanStatistics]:
    """Statistics of each scene, by kind of place and number; sensors and routes are drawn as in training."""
    mixture = SceneMixture()
    wanted = [(kind, number) for number in range(config.scenes) for kind, _ in mixture.kinds]

    def measure(scene: tuple[str, int]) -> ScanStatistics:
        seed = _FIRST_SEED + 1000 * config.seed + wanted.index(scene)
        return scan_statistics(evenly(simulate_drive(seed, kind=scene[0]), config.scans))

    return {scene: measure(scene) for scene in tqdm(wanted, desc="scenes", leave=False)}


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))

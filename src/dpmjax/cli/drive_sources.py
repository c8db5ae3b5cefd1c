"""Drives of a command line: simulated towns, folders of scans with poses, or poses that a town is simulated along."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpmjax.cli.route_drives import is_route, route_drive
from dpmjax.deeppointmap import SamplingConfig, why_useless
from dpmjax.io import LidarSequence, list_lidar_sequences, open_lidar_sequence
from dpmjax.simulation import SceneMixture, simulate_drive

LOGGER = logging.getLogger("dpmjax.drives")
TOWN = "town"
DEFAULT_MIXTURE = SceneMixture()


@dataclass(frozen=True)
class Source:
    """Origin of a drive.

    Attributes:
        path: folder of scans, or a file of poses along which a town is simulated; None for any town.
        name: name of the sequence in the folder; None where it holds one.
        town_seed: seed of the town.
        town_length_m: length of the drive through the town.
        town_kind: kind of place; None draws one.
        town_mixture: distribution from which the town is drawn.
    """

    path: Path | None = None
    name: str | None = None
    town_seed: int = 0
    town_length_m: float = 600.0
    town_kind: str | None = None
    town_mixture: SceneMixture = DEFAULT_MIXTURE

    def open(self) -> LidarSequence:
        """Opens or simulates the drive; of one with reference poses, the scans that have one."""
        if self.path is None:
            return simulate_drive(
                self.town_seed, length_m=self.town_length_m, kind=self.town_kind, mixture=self.town_mixture
            )
        if is_route(self.path):
            return route_drive(self.path, self.town_seed)
        drive = open_lidar_sequence(self.path, sequence=self.name)
        return drive if drive.T_world_lidar is None else drive.take(np.flatnonzero(drive.has_reference))


def find_sources(data: Sequence[str], towns: Sequence[Source], sampling: SamplingConfig | None = None) -> list[Source]:
    """Returns the drives of the entries of a command line, checked; those of the towns where an entry is `town`.

    Args:
        data: folders or files of poses, or `town` for the towns.
        towns: such as the seeds of the run give.
        sampling: distances at which a drive must have pairs of scans; None takes the published ones.

    Returns:
        The drives, in order.

    Raises:
        ValueError: if a path cannot be read or holds no useful drive.
    """
    sources: list[Source] = []
    sampling = sampling or SamplingConfig()
    for entry in data:
        if entry == TOWN and not Path(entry).exists():
            sources += towns
            continue
        names: Sequence[str | None] = list_lidar_sequences(entry) or [None]
        found = {source: source.open() for source in (Source(Path(entry), name) for name in names)}
        checked = ((source, why_useless(drive, sampling)) for source, drive in found.items())
        reasons = {source: reason for source, reason in checked if reason is not None}
        if len(reasons) == len(found):
            raise ValueError("; ".join(f"{entry}: {reason}" for reason in dict.fromkeys(reasons.values())))
        for source, reason in reasons.items():
            LOGGER.warning("%s is left out: %s", found[source].name, reason)
        sources += [source for source in found if source not in reasons]
    return sources

"""Spinning lidars by their beam tables."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class LidarSensor:
    """A spinning lidar: one column of beams that turns about z.

    Hashable, so that it can be a static argument of a kernel.

    Attributes:
        name: for titles and files.
        elevations_deg: angle of each beam above the horizontal, highest first.
        num_azimuths: columns in a turn; they go clockwise from straight behind, as a range image is looked at.
        min_range_m: what is nearer is not returned.
        max_range_m: what is farther is not returned.
        range_noise_m: standard deviation of a range.
        drop_rate: part of the returns that is lost anyway.
        reach_m: range at which half of the returns of a surface of 20 % reflectivity, met head-on, are lost.
        height_m: mounting height above the ground, for drives.

    Raises:
        ValueError: no beams, fewer than 8 columns, or ranges that are not 0 <= min < max.
    """

    name: str
    elevations_deg: tuple[float, ...]
    num_azimuths: int
    min_range_m: float = 1.0
    max_range_m: float = 100.0
    range_noise_m: float = 0.02
    drop_rate: float = 0.03
    reach_m: float = 75.0
    height_m: float = 1.73

    def __post_init__(self) -> None:
        if not self.elevations_deg or self.num_azimuths < 8:
            raise ValueError(
                f"a sensor needs beams and at least 8 azimuths, got {len(self.elevations_deg)} and {self.num_azimuths}"
            )
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(f"ranges must be 0 <= min < max, got {self.min_range_m} and {self.max_range_m}")

    @property
    def num_rays(self) -> int:
        """Rays in a turn."""
        return len(self.elevations_deg) * self.num_azimuths

    def with_azimuths(self, num_azimuths: int) -> LidarSensor:
        """The same sensor with fewer or more columns: cheaper scans for training."""
        return replace(self, num_azimuths=num_azimuths)


def _spread(top_deg: float, bottom_deg: float, count: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.linspace(top_deg, bottom_deg, count))


HDL64E = LidarSensor(
    # Velodyne's manual: 32 lasers a third of a degree apart, and 32 below them half a degree apart (as on KITTI's car).
    name="hdl64e",
    elevations_deg=_spread(2.0, -8.33, 32) + _spread(-8.83, -24.33, 32),
    num_azimuths=1800,
    max_range_m=80.0,
)
OS1_64 = LidarSensor(
    # Ouster OS1-64 of the first generation, as on MulRan's car.
    name="os1_64",
    elevations_deg=_spread(16.6, -16.6, 64),
    num_azimuths=1024,
    range_noise_m=0.03,
    reach_m=60.0,
    height_m=1.85,
)
HDL32E = LidarSensor(
    name="hdl32e", elevations_deg=_spread(10.67, -30.67, 32), num_azimuths=1080, max_range_m=80.0, height_m=1.84
)
VLP16 = LidarSensor(name="vlp16", elevations_deg=_spread(15.0, -15.0, 16), num_azimuths=1800, range_noise_m=0.03)

SENSORS = {sensor.name: sensor for sensor in (HDL64E, OS1_64, HDL32E, VLP16)}

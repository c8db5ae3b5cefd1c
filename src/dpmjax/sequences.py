"""Results of readers and simulators: scans, depth images and drives, with their poses.

NumPy only, on the host. `dpmjax.io` and `dpmjax.simulation` make these records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Unit = Literal["px", "m"]
BoolArray = NDArray[np.bool_]
# Start, stop and stride in scans, or the rows to keep, in the order wanted.
Selection = slice | NDArray[np.integer] | NDArray[np.bool_]


class InputError(ValueError):
    """The user's input is not usable: one line with the file, the finding and the advice.

    The command line prints the line and ends with exit code 2; nothing has been written by then.

    Args:
        source: the file or folder at fault.
        found: the finding, without a final full stop.
        advice: what to do about it, without a final full stop.
    """

    def __init__(self, source: str | Path, found: str, advice: str) -> None:
        self.source, self.found, self.advice = str(source), found, advice
        super().__init__(" ".join(f"{source}: {found}; {advice}.".split()))


class EmptyScanError(InputError):
    """A scan without any point: the lidar measured nothing, or the file is empty. A drive continues without it."""


class Note(NamedTuple):
    """A decision of a reader about its input, or a doubt.

    Attributes:
        text: one line that names the file.
        is_doubt: True if the input may be wrong; False for a mere decision.
    """

    text: str
    is_doubt: bool = False


def require(is_good: bool | np.bool_, source: str | Path, found: str, advice: str) -> None:
    """Raises an `InputError` unless the input is good.

    Args:
        is_good: the check.
        source: see `InputError`.
        found: the finding where the check fails.
        advice: what to do then.

    Raises:
        InputError: the check fails.
    """
    if not is_good:
        raise InputError(source, found, advice)


def counted(number: int, noun: str) -> str:
    """Returns a number with its noun, which is given in the singular, in the plural unless the number is 1."""
    return f"{number} {noun}{'s' * (number != 1)}"


def homogeneous(rotations: FloatArray, translations: FloatArray) -> FloatArray:
    """Builds homogeneous matrices.

    Args:
        rotations: (..., 3, 3).
        translations: (..., 3).

    Returns:
        (..., 4, 4).
    """
    matrices = np.tile(np.eye(4), (*translations.shape[:-1], 1, 1))
    matrices[..., :3, :3], matrices[..., :3, 3] = rotations, translations
    return matrices


def _require_shapes(record: Any, shapes: dict[str, tuple[int, ...]]) -> None:
    """Raises a ValueError for the first field that is present and has another shape."""
    for name, shape in shapes.items():
        value = getattr(record, name)
        if value is not None and value.shape != shape:
            raise ValueError(f"{name} must be {shape}, got {value.shape}")


def _select(record: Any, names: tuple[str, ...], selection: Selection) -> dict[str, Any]:
    """Selects rows of each field that is present."""
    values = {name: getattr(record, name) for name in names}
    return {name: None if value is None else value[selection] for name, value in values.items()}


@dataclass(frozen=True)
class ScanSequence:
    """A sequence of planar scans.

    Attributes:
        name: short name of the source, for titles and folders.
        points: (n, b, 2) float32 beam end points in the sensor frame (x forward, y left), in `unit`; zero where masked.
        mask: (n, b) bool, True where the beam measured something.
        unit: unit of lengths.
        reference_poses: (n, 3) float64 x, y, heading of the sensor in the world (`unit`, radians), or None.
        odometry_poses: (n, 3) float64, raw odometry in its own world, or None where the source has none.
        times: (n,) float64 seconds, or None.
        notes: decisions of the reader about the input, and doubts.

    Raises:
        ValueError: shapes that do not belong together, or a unit other than "px" and "m".
    """

    name: str
    points: NDArray[np.float32] = field(repr=False)
    mask: BoolArray = field(repr=False)
    unit: Unit
    reference_poses: FloatArray | None = field(default=None, repr=False)
    odometry_poses: FloatArray | None = field(default=None, repr=False)
    times: FloatArray | None = field(default=None, repr=False)
    notes: tuple[Note, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        if self.unit not in ("px", "m"):
            raise ValueError(f"unit must be 'px' or 'm', got {self.unit!r}")
        if self.points.ndim != 3 or self.points.shape[2] != 2:
            raise ValueError(f"points must be (n, b, 2), got {self.points.shape}")
        n = len(self.points)
        shapes = {"mask": self.points.shape[:2], "reference_poses": (n, 3), "odometry_poses": (n, 3), "times": (n,)}
        _require_shapes(self, shapes)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def is_organised(self) -> bool:
        """True where beams are ordered by angle: neighbours in the array are neighbours in the world."""
        return has_angular_order(self.points, self.mask)

    def take(self, selection: Selection) -> ScanSequence:
        """Selects scans with their poses and times; arrays are views where `selection` is a slice."""
        names = ("points", "mask", "reference_poses", "odometry_poses", "times")
        return replace(self, **_select(self, names, selection))


class Relations(NamedTuple):
    """Relative poses of a robot at pairs of times, checked by hand.

    Attributes:
        times_from: (r,) seconds.
        times_to: (r,) seconds.
        T_from_to: (r, 3) x, y in metres and heading at `times_to`, in the frame of the robot at `times_from`.
    """

    times_from: FloatArray
    times_to: FloatArray
    T_from_to: FloatArray


def pad_scans(scans: Sequence[NDArray[np.floating]]) -> tuple[NDArray[np.float32], BoolArray]:
    """Stacks planar scans of different numbers of beams.

    Args:
        scans: n scans, each (its number of beams, 2) end points; NaN for beams that measured nothing.

    Returns:
        points: (n, b, 2) float32; zero where masked.
        mask: (n, b) True where a beam measured something; beams behind the last of a scan are masked.
    """
    mask = np.zeros((len(scans), max(len(scan) for scan in scans)), bool)
    points = np.zeros((*mask.shape, 2), np.float32)
    for row, valid, scan in zip(points, mask, scans, strict=True):
        valid[: len(scan)] = ~np.isnan(scan).any(axis=1)
        row[valid] = scan[valid[: len(scan)]]
    return points, mask


def has_angular_order(points: NDArray[np.float32], mask: BoolArray) -> bool:
    """Returns True where the beams of scans are ordered by angle, as 1-D convolutions and neighbour normals need it.

    In an ordered scan at least 95 % of the turns from one valid beam to the next have one direction. Their sum is one
    turn at most (plus 5 % for noise). The sequence is in order when at least 90 % of its scans are. Scans with
    fewer than three valid beams do not count.

    Args:
        points: (n, b, 2) in the sensor frame.
        mask: (n, b).

    Returns:
        True for ordered beams; False where no scan has three valid beams.
    """
    is_ordered = []
    for scan, valid in zip(points, mask, strict=True):
        if valid.sum() < 3:
            continue
        angle = np.arctan2(scan[valid, 1], scan[valid, 0])
        turn = (np.diff(angle.astype(np.float64)) + np.pi) % (2 * np.pi) - np.pi
        same_way = max((turn > 0).mean(), (turn < 0).mean())
        is_ordered.append(same_way >= 0.95 and np.abs(turn).sum() <= 1.05 * 2 * np.pi)
    return bool(is_ordered) and float(np.mean(is_ordered)) >= 0.9


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; its frame is x to the right, y down, z forward.

    Attributes:
        width: width of the image, pixels.
        height: height of the image, pixels.
        fx: focal length along x, pixels.
        fy: focal length along y, pixels.
        cx: column of the optical axis, pixels from the centre of the first.
        cy: row of the optical axis.

    Raises:
        ValueError: a size or a focal length that is not positive and finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if min(self.width, self.height) < 1 or not min(self.fx, self.fy) > 0.0 or not np.isfinite(numbers).all():
            raise ValueError(f"camera: expected a size and focal lengths above 0, got {self}")

    def rays(self, columns: NDArray[Any], rows: NDArray[Any]) -> FloatArray:
        """Computes directions (h, w, 3) with z = 1 of the pixels at rows (h,) and columns (w,)."""
        x, y = np.meshgrid((columns - self.cx) / self.fx, (rows - self.cy) / self.fy)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def sample_pixels(self, height: int, width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Chooses rows (height,) and columns (width,) spread evenly over the image, in the middles of their cells."""
        rows = ((np.arange(height) + 0.5) * self.height / height).astype(np.int64)
        return rows, ((np.arange(width) + 0.5) * self.width / width).astype(np.int64)


# The camera of the Active Vision Dataset.
ACTIVE_VISION = Camera(1920, 1080, 1070.0, 1069.126, 927.268, 545.76)


@dataclass(frozen=True)
class DepthSequence:
    """Depth images as organised clouds, in the order in which they were taken.

    Attributes:
        name: name for titles and messages.
        points: (n, h, w, 3) float32 metres in the camera frame (x right, y down, z forward); zero where masked.
        mask: (n, h, w) bool.
        is_planar: True where the camera moved in a plane: x, z and the angle about y.
        T_world_camera: (n, 4, 4) float64 reference poses, or None.

    Raises:
        ValueError: shapes that do not belong together.
    """

    name: str
    points: NDArray[np.float32] = field(repr=False)
    mask: BoolArray = field(repr=False)
    is_planar: bool
    T_world_camera: FloatArray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.points.ndim != 4 or self.points.shape[3] != 3:
            raise ValueError(f"points must be (n, h, w, 3), got {self.points.shape}")
        _require_shapes(self, {"mask": self.points.shape[:3], "T_world_camera": (len(self.points), 4, 4)})

    def __len__(self) -> int:
        return len(self.points)

    def take(self, selection: Selection) -> DepthSequence:
        """Selects images with their poses."""
        return replace(self, **_select(self, ("points", "mask", "T_world_camera"), selection))


@dataclass(frozen=True)
class LidarSequence:
    """Scans of one drive, read lazily: `sequence[i]` reads scan i, and a loop reads the scans in turn.

    Read this way, a scan without points is (0, 3).

    Attributes:
        name: short name of the source, for titles and folders.
        sources: source of each scan, in general a file.
        read_scan: read_scan(i) gives scan i as (n, 3) float32 points in the lidar's frame (x forward, y left, z up), m.
            A bad scan raises an InputError that names the file.
        T_world_lidar: (n, 4, 4) float64 reference poses, NaN for scans without one; or None.
        times: (n,) float64 s, or None.
        read_times: read_times(i) gives the times of the points of scan i, (n,) float64 in the unit of its file, or None
            where the file has none; it raises the same errors. None: no scan has times.
        notes: decisions of the reader about the input, and doubts.

    Raises:
        ValueError: poses or times that are not one a scan.
    """

    name: str
    sources: tuple[str, ...] = field(repr=False)
    read_scan: Callable[[int], NDArray[np.float32]] = field(repr=False)
    T_world_lidar: FloatArray | None = field(default=None, repr=False)
    times: FloatArray | None = field(default=None, repr=False)
    read_times: Callable[[int], FloatArray | None] | None = field(default=None, repr=False)
    notes: tuple[Note, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        _require_shapes(self, {"T_world_lidar": (len(self), 4, 4), "times": (len(self),)})

    def __getitem__(self, index: int) -> NDArray[np.float32]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scan: expected a number below {len(self)}, got {index}")
        return self.read_points(index % len(self))

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        return (self.read_points(index) for index in range(len(self)))

    @property
    def has_reference(self) -> BoolArray:
        """(n,) True for scans with a reference pose."""
        T = self.T_world_lidar
        return np.zeros(len(self), bool) if T is None else np.asarray(np.isfinite(T.reshape(-1, 16)).all(axis=1))

    def __len__(self) -> int:
        return len(self.sources)

    def read_points(self, index: int) -> NDArray[np.float32]:
        """Reads scan i as `read_scan` does; a scan of no point is (0, 3), not an error."""
        try:
            return self.read_scan(index)
        except EmptyScanError:
            return np.zeros((0, 3), np.float32)

    def from_base(self, T_base_lidar: FloatArray) -> LidarSequence:
        """Moves points and reference poses that are in the robot's frame, as those of Argoverse, to the lidar's frame.

        Args:
            T_base_lidar: (4, 4) pose of the lidar on the robot.

        Returns:
            The sequence; beams begin at the origin of its scans.
        """
        R, t, poses = T_base_lidar[:3, :3], T_base_lidar[:3, 3], self.T_world_lidar
        return replace(
            self,
            read_scan=lambda index: ((self.read_scan(index) - t) @ R).astype(np.float32),
            T_world_lidar=None if poses is None else poses @ T_base_lidar,
        )

    def take(self, selection: Selection) -> LidarSequence:
        """Selects scans with their poses and times, in the same world; nothing is read."""
        numbers = [int(i) for i in np.arange(len(self))[selection]]
        sources, chosen = tuple(self.sources[i] for i in numbers), _select(self, ("T_world_lidar", "times"), selection)
        read_times = self.read_times
        return replace(
            self,
            sources=sources,
            read_scan=lambda index: self.read_scan(numbers[index]),
            read_times=None if read_times is None else lambda index: read_times(numbers[index]),
            **chosen,
        )


@dataclass(frozen=True)
class SimulatedDrive(LidarSequence):
    """A simulated drive, whose poses are known."""

    T_world_lidar: FloatArray = field(repr=False)

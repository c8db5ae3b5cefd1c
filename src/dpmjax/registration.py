"""Registration of scans of any sensor, by one name each: `register` for two, `register_scans` for a set.

The shape of the arrays determines the sensor: planar scans are (n, 2), depth images (h, w, 3), lidar scans (n, 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, overload

import jax
import numpy as np
from numpy.typing import ArrayLike

from dpmjax import deeppointmap, scan, slam
from dpmjax.checks import runs_on_host
from dpmjax.deeppointmap.encoding import ScanOrCloud
from dpmjax.deeppointmap.model import Model
from dpmjax.progress import progress_bar
from dpmjax.scan.pair_evidence import ScanRegistration
from dpmjax.types import RawScan, Registration, ScanSet

if TYPE_CHECKING:  # a registration of two scans needs no DeepMapping, which takes a while to load
    from dpmjax.slam import RegisteredClouds, RegisteredScans, RegistrationConfig


@overload
def register(
    model: Model,
    source: ScanOrCloud,
    target: ScanOrCloud,
    *,
    refine: bool | None = None,
) -> Registration: ...


@overload
def register(model: None, source: ArrayLike, target: ArrayLike) -> ScanRegistration: ...


@runs_on_host("call icp, or correlate and weighted_svd, there")
def register(model: Model | None, source: Any, target: Any, **options: Any) -> Registration | ScanRegistration:
    """Registers two scans of one sensor without a first guess.

    With a model, lidar scans, maps and descriptor clouds are registered by `deeppointmap.register` (DeepPointMap
    section 3.2); without one, lidar scans by their views from above and their surfaces. Planar scans (an exhaustive
    search) and depth images (a search of motions up to 0.7 m and 75 degrees) need no model.

    Args:
        model: a trained model; None for none.
        source: planar scan (n, 2), any unit; depth image (h, w, 3) in the frame of the camera, or lidar scan (n, 3),
            metres. With a model also a prepared scan or a descriptor cloud.
        target: the same.
        **options: of `deeppointmap.register`, with a model only: refine.

    Returns:
        `T_target_source`, which maps points of the source to the target; `confidence`, the probability that it is
        right; and the weak direction. `ScanRegistration` has the lead over the best other motion, too.

    Raises:
        ValueError: wrong shapes, scans of two sensors, or too few points.
    """
    kinds = {_kind(scan) for scan in (source, target)}
    if kinds == {"planar"}:
        return scan.register_planar(source, target)
    if kinds == {"depth"}:
        return scan.register_images(source, target)
    if kinds & {"planar", "depth"}:
        shapes = " and ".join(str(np.shape(scan)) for scan in (source, target))
        raise ValueError(f"source, target: expected scans of one sensor, (n, 2), (h, w, 3) or (n, 3), got {shapes}")
    if model is None:
        return scan.register_surfaces(source, target)
    return deeppointmap.register(model, source, target, **options)


def _kind(scan: Any) -> str:
    """Returns the sensor of a scan by the shape of its array."""
    shape = np.shape(scan) if isinstance(scan, np.ndarray | jax.Array | list) else ()
    if len(shape) == 3 and shape[2] == 3:
        return "depth"
    return "planar" if len(shape) == 2 and shape[1] == 2 else "lidar"


@overload
def register_scans(
    model: Model, scans: Sequence[RawScan], *, is_ordered: bool = False, progress: bool = True
) -> RegisteredClouds: ...


@overload
def register_scans(
    scans: ScanSet | ArrayLike, config: RegistrationConfig | None = None, *, key: jax.Array, **options: Any
) -> RegisteredScans: ...


def register_scans(
    *scans: Any, is_ordered: bool | None = None, progress: bool = True, **options: Any
) -> RegisteredScans | RegisteredClouds:
    """Registers a set of scans of one sensor: planar scans, or 3-D scans without poses and order by a model.

        register_scans(scans, config, key=key)              # planar: `slam.register_scans`
        register_scans(model, clouds, is_ordered=False)     # 3-D: `slam.register_unposed`

    Args:
        *scans: planar scans (n, b, 2) and perhaps their settings; or a model and a list of (n, 3) arrays, metres.
        is_ordered: True if the scans are in time order. None takes the setting of planar scans, and False for 3-D
            scans. `run_slam` maps 3-D scans in time order.
        progress: False shows no bar; hooks of your own take its place.
        **options: of `slam.register_scans`: key, start, odometry, hooks.

    Returns:
        Poses of all scans, and the evidence for them.

    Raises:
        ValueError: see the two functions; or ordered 3-D scans.
    """
    if isinstance(scans[0], Model):
        if is_ordered:
            raise ValueError("is_ordered: expected False for 3-D scans; run_slam maps them in the order of time")
        return slam.register_unposed(*scans, progress=progress, **options)
    if is_ordered is not None:
        config = (scans[1] if len(scans) > 1 else options.pop("config", None)) or slam.RegistrationConfig()
        scans = (scans[0], replace(config, is_ordered=is_ordered))
    hooks = options.pop("hooks", None)
    with progress_bar("registration", is_shown=progress and hooks is None) as bar:

        def show(stage: str, share: float) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(share - bar.n)

        return slam.register_scans(*scans, hooks=hooks or slam.RegistrationHooks(show), **options)

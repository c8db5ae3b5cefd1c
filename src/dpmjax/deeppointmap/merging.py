"""From scan to map: the union of descriptor clouds, without any new extraction (DeepPointMap section 3.1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dpmjax.checks import as_float, require_shape
from dpmjax.geometry import rigid
from dpmjax.types import AnyArray, DescriptorCloud


def merge_clouds(clouds: DescriptorCloud, T_map_cloud: Float[AnyArray, "s 4 4"]) -> DescriptorCloud:
    """The union of several descriptor clouds in one frame.

    Args:
        clouds: s clouds of equal capacity, stacked: positions (s, m, 3), features (s, m, c), mask (s, m).
        T_map_cloud: the pose of each in the frame of the map, metres. That of a cloud with no valid descriptor may be
            anything.

    Returns:
        One cloud of capacity s * m; what is masked holds 0 as position.

    Raises:
        ValueError: the shapes do not match.
    """
    if clouds.positions.ndim != 3:
        raise ValueError(f"clouds: expected stacked clouds, positions (s, m, 3), got {clouds.positions.shape}")
    T_map_cloud = as_float("T_map_cloud", T_map_cloud)
    require_shape("T_map_cloud", T_map_cloud, (len(clouds.positions), 4, 4))
    return _merge_clouds(clouds, T_map_cloud)


@jax.jit
def _merge_clouds(clouds: DescriptorCloud, T_map_cloud: jax.Array) -> DescriptorCloud:
    positions_cloud = jnp.where(clouds.mask[..., None], clouds.positions, 0)
    T_map_cloud = jnp.where(jnp.any(clouds.mask, axis=1)[:, None, None], T_map_cloud, 0)
    positions_map = jnp.where(clouds.mask[..., None], rigid.transform_points(T_map_cloud, positions_cloud), 0)
    return DescriptorCloud(
        positions=positions_map.reshape(-1, 3),
        features=clouds.features.reshape(-1, clouds.features.shape[-1]),
        mask=clouds.mask.reshape(-1),
    )

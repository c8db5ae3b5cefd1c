"""A simulated town for a spinning lidar, made by seed: streets, houses, cars, trees, and a ray caster in JAX.

`make_town` builds it on the host, `drive` lays a drive through it, `scan_town` is what the sensor measures at a pose: a
jitted kernel, so that training data can be made on the device. `simulate_lidar_sequence` does all three.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

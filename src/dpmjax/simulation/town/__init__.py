"""A simulated town for a spinning lidar, made by seed: streets, houses, cars, trees, and a ray caster in JAX.

`make_town` builds it on the host, `drive` drives along its route, and `scan_town` takes a scan at a pose. `scan_town`
is a jitted kernel, so that training data can be made on the device. `simulate_scene` does all three.
"""

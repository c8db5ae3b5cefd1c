"""A map in a file: single scans are found in it without a first guess, and two maps become one."""

from pathlib import Path

import numpy as np

import dpmjax
from dpmjax import simulation

drive = simulation.simulate_drive(3, kind="suburb", length_m=80)
model = dpmjax.load_model("dpm_small")
result = dpmjax.run_slam(model, (drive[i] for i in range(0, 24)))
dpmjax.save_map("map.npz", result.map, precision="int8")
print(f"{len(result.keyframes)} keyframes, {Path('map.npz').stat().st_size / 1e6:.2f} MB")

# Scan 15 was taken inside the map; the map's frame is that of scan 0.
slam_map = dpmjax.load_map("map.npz")
found = dpmjax.localize(model, slam_map, drive[15])
T_map_scan = np.linalg.inv(drive.T_world_lidar[0]) @ drive.T_world_lidar[15]
print(found.status, f"{np.linalg.norm((found.T_world_scan - T_map_scan)[:3, 3]):.2f} m", found.reason)

# A scan of another town is not found.
elsewhere = simulation.simulate_drive(6, kind="suburb", length_m=10)
print(dpmjax.localize(model, slam_map, elsewhere[0]).status)

# A second run over the last part of the same street, with a frame of its own.
second = dpmjax.run_slam(model, (drive[i] for i in range(12, 40)))
merged = dpmjax.merge_maps(model, result.map, second.map)
print(f"joined: {merged.is_joined}, {len(merged.maps[0])} keyframes")

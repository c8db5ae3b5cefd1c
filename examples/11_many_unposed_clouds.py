"""Shuffled 3-D scans without poses or order end in one frame, or in parts that say so."""

import numpy as np

import dpmjax
from dpmjax import simulation

# Every second scan of a drive, in no order, each in the frame of its own lidar.
drive = simulation.simulate_drive(3, kind="suburb", length_m=60)
rows = np.random.default_rng(0).permutation(np.arange(0, len(drive), 2))
clouds = [drive[row] for row in rows]

model = dpmjax.load_model("dpm_small")
found = dpmjax.register_scans(model, clouds, is_ordered=False)

truth = drive.T_world_lidar[rows]
for part in range(found.part.max() + 1):
    members = np.flatnonzero(found.part == part)
    error = dpmjax.absolute_trajectory_error(found.T_world_scan[members, :3, 3], truth[members, :3, 3])
    print(f"part {part}: {len(members)} scans, ATE {error:.3f} m")
used = sum(pair.is_used for pair in found.pairs)
print(f"{used} of {len(found.pairs)} registered pairs agree with the result; all in one frame: {found.is_joined}")

"""Two 3-D scans without a first guess: their relative pose, and the probability that it is right."""

import numpy as np

import dpmjax
from dpmjax import simulation

# A simulated street and a lidar of 64 beams, two metres from scan to scan.
drive = simulation.simulate_drive(3, kind="suburb", length_m=30)
source, target = drive[0], drive[7]  # (n, 3) points in metres, each in the frame of its lidar.

model = dpmjax.load_model("dpm_small")
match = dpmjax.register(model, source, target)

T_source, T_target = drive.T_world_lidar[0], drive.T_world_lidar[7]
error_m = np.linalg.norm((np.linalg.inv(T_target) @ T_source - match.T_target_source)[:3, 3])
print(f"error {error_m:.3f} m, probability {match.confidence:.3f}, overlap {dpmjax.overlap(model, source, target):.3f}")

# A robot may send 256 descriptors and 1,024 surface elements instead of 50,000 points: the same call registers them.
sent, own = (dpmjax.encode(model, points, num_elements=1024) for points in (source, target))
match = dpmjax.register(model, sent, own)
error_m = np.linalg.norm((np.linalg.inv(T_target) @ T_source - match.T_target_source)[:3, 3])
print(f"by {sent.features.shape} descriptors alone: error {error_m:.3f} m, probability {match.confidence:.3f}")

# Planar scans need no model, nor do depth images, nor lidar scans.
walk = simulation.simulate_sequence(0, 8)
planar = dpmjax.register(None, walk.points[0], walk.points[1])
print(f"planar scans: probability {planar.confidence:.3f}, lead {planar.lead:.2f}")

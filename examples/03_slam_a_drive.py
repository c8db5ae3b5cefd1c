"""A drive of 3-D scans becomes one map: a pose for every scan, loops, and a pose graph."""

import dpmjax
from dpmjax import io, simulation

# Once round a block of a simulated suburb, and on over known streets.
town = simulation.TownConfig("suburb", "loop", route_length_m=200.0, block_m=50.0)
driving = simulation.DriveConfig(rate_hz=3.0, length_m=240.0, max_turn_deg_s=30.0)
drive = simulation.simulate_scene(simulation.Scene(0, town, driving, simulation.HDL64E.with_azimuths(900)))

model = dpmjax.load_model("dpm_small")
result = dpmjax.run_slam(model, drive)

reference = drive.T_world_lidar[:, :3, 3]
for name, poses in (("odometry", result.T_odometry_scan), ("with loops", result.T_world_scan)):
    print(f"{name}: ATE {dpmjax.absolute_trajectory_error(poses[:, :3, 3], reference):.3f} m")
accepted = [loop for loop in result.loops if loop.status == "accepted"]
print(f"{len(result.keyframes)} keyframes, {len(accepted)} loops")

# Files that evo and other tools read.
io.write_tum("trajectory_tum.txt", result.T_world_scan, times=drive.times)
dpmjax.write_g2o("graph.g2o", result.graph)

# The graph can be optimised again, or with edges of your own.
solved = dpmjax.optimize_pose_graph(dpmjax.read_g2o("graph.g2o"))
print(f"chi2 {solved.chi2_initial:.1f} -> {solved.chi2:.1f}")

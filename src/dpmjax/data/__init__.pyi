from .arrays import read_arrays
from .carmen import read_carmen_log
from .deepmapping_folder import read_deepmapping_folder, write_deepmapping_folder
from .errors import InputError
from .files import write_atomically
from .pcd import read_pcd, write_pcd
from .raycast2d import RayHits, beam_angles, cast_rays, scan_world
from .readers import read_sequence
from .sequence import ScanSequence, has_angular_order, take_scans
from .simulate2d import simulate_sequence
from .trajectory2d import TrajectoryConfig, simulate_odometry, simulate_trajectory
from .trajectory_files import planar_to_homogeneous, read_initial_poses, write_kitti, write_poses_npy, write_tum
from .world2d import World, make_world, read_world_png, write_world_png

__all__ = [
    "InputError",
    "RayHits",
    "ScanSequence",
    "TrajectoryConfig",
    "World",
    "beam_angles",
    "cast_rays",
    "has_angular_order",
    "make_world",
    "planar_to_homogeneous",
    "read_arrays",
    "read_carmen_log",
    "read_deepmapping_folder",
    "read_initial_poses",
    "read_pcd",
    "read_sequence",
    "read_world_png",
    "scan_world",
    "simulate_odometry",
    "simulate_sequence",
    "simulate_trajectory",
    "take_scans",
    "write_atomically",
    "write_deepmapping_folder",
    "write_kitti",
    "write_pcd",
    "write_poses_npy",
    "write_tum",
    "write_world_png",
]

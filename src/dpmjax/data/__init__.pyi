from .arrays import read_arrays
from .carmen import read_carmen_log
from .deepmapping_folder import read_deepmapping_folder, write_deepmapping_folder
from .errors import InputError
from .files import write_atomically
from .lidar_files import read_lidar_file
from .lidar_readers import list_lidar_sequences, open_lidar_sequence
from .lidar_sequence import BadScan, IndexedScan, LidarSequence, iterate_scans, take_lidar_scans
from .pcd import read_pcd, write_pcd
from .ply import read_ply, write_ply
from .position_bound import position_bound
from .raycast2d import RayHits, beam_angles, cast_rays, scan_world
from .readers import read_sequence
from .sequence import ScanSequence, has_angular_order, take_scans
from .simulate2d import simulate_sequence
from .town import (
    HDL32E,
    HDL64E,
    OS1_64,
    SENSORS,
    VLP16,
    CastConfig,
    Drive,
    DriveConfig,
    LidarSensor,
    Town,
    TownConfig,
    TownPrimitives,
    drive,
    make_town,
    range_image,
    scan_town,
    simulate_lidar_sequence,
    write_kitti_sequence,
)
from .trajectory2d import TrajectoryConfig, simulate_odometry, simulate_trajectory
from .trajectory_files import planar_to_homogeneous, read_initial_poses, write_kitti, write_poses_npy, write_tum
from .world2d import World, make_world, read_world_png, write_world_png

__all__ = [
    "HDL32E",
    "HDL64E",
    "OS1_64",
    "SENSORS",
    "VLP16",
    "BadScan",
    "CastConfig",
    "Drive",
    "DriveConfig",
    "IndexedScan",
    "InputError",
    "LidarSensor",
    "LidarSequence",
    "RayHits",
    "ScanSequence",
    "Town",
    "TownConfig",
    "TownPrimitives",
    "TrajectoryConfig",
    "World",
    "beam_angles",
    "cast_rays",
    "drive",
    "has_angular_order",
    "iterate_scans",
    "list_lidar_sequences",
    "make_town",
    "make_world",
    "open_lidar_sequence",
    "planar_to_homogeneous",
    "position_bound",
    "range_image",
    "read_arrays",
    "read_carmen_log",
    "read_deepmapping_folder",
    "read_initial_poses",
    "read_lidar_file",
    "read_pcd",
    "read_ply",
    "read_sequence",
    "read_world_png",
    "scan_town",
    "scan_world",
    "simulate_lidar_sequence",
    "simulate_odometry",
    "simulate_sequence",
    "simulate_trajectory",
    "take_lidar_scans",
    "take_scans",
    "write_atomically",
    "write_deepmapping_folder",
    "write_kitti",
    "write_kitti_sequence",
    "write_pcd",
    "write_ply",
    "write_poses_npy",
    "write_tum",
    "write_world_png",
]

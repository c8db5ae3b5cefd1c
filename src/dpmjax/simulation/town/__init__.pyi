from .cast import CastConfig
from .driving import Drive, DriveConfig, drive
from .make import Town, TownConfig, make_town
from .primitives import TownPrimitives
from .scan import range_image, scan_town
from .sensors import HDL32E, HDL64E, OS1_64, SENSORS, VLP16, LidarSensor
from .simulate import simulate_lidar_sequence, write_kitti_sequence

__all__ = [
    "HDL32E",
    "HDL64E",
    "OS1_64",
    "SENSORS",
    "VLP16",
    "CastConfig",
    "Drive",
    "DriveConfig",
    "LidarSensor",
    "Town",
    "TownConfig",
    "TownPrimitives",
    "drive",
    "make_town",
    "range_image",
    "scan_town",
    "simulate_lidar_sequence",
    "write_kitti_sequence",
]

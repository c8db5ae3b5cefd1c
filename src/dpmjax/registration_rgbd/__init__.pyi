from .depth_images import DepthScans as DepthScans
from .depth_images import Pinhole as Pinhole
from .depth_images import as_depth_scans as as_depth_scans
from .pair_registration import register_images as register_images
from .projective_consistency import projective_consistency as projective_consistency
from .trajectory_search import PlacedImages as PlacedImages
from .trajectory_search import initialize_depth as initialize_depth

from .depth_images import DepthScans as DepthScans
from .depth_images import Pinhole as Pinhole
from .depth_images import as_depth_scans as as_depth_scans
from .motion_search import DepthSearchConfig as DepthSearchConfig
from .motion_search import depth_search as depth_search
from .projective_consistency import projective_consistency as projective_consistency
from .trajectory_search import initialize_depth as initialize_depth

from .deepmapping.fit import fit_deepmapping as fit_deepmapping
from .geometry.alignment import weighted_svd as weighted_svd
from .geometry.neighbours import k_nearest as k_nearest
from .geometry.neighbours import radius_search as radius_search
from .geometry.normals import estimate_normals as estimate_normals
from .geometry.rays import sample_free_space as sample_free_space
from .geometry.sampling import farthest_point_sample as farthest_point_sample
from .geometry.sampling import voxel_sample as voxel_sample
from .losses.chamfer import chamfer_distance as chamfer_distance
from .losses.contrastive import info_nce as info_nce
from .losses.occupancy import occupancy_loss as occupancy_loss
from .metrics.trajectory import absolute_trajectory_error as absolute_trajectory_error
from .metrics.trajectory import align_rigid as align_rigid
from .metrics.trajectory import point_distance as point_distance
from .metrics.trajectory import relative_pose_error as relative_pose_error
from .registration.icp import icp as icp
from .types import Neighbours as Neighbours
from .types import ScanSet as ScanSet

__version__: str

from .position_bound import position_bound as position_bound
from .recall import RegistrationRecall as RegistrationRecall
from .recall import registration_recall as registration_recall
from .trajectory import RelativePoseError as RelativePoseError
from .trajectory import absolute_trajectory_error as absolute_trajectory_error
from .trajectory import align_rigid as align_rigid
from .trajectory import point_distance as point_distance
from .trajectory import relative_pose_error as relative_pose_error

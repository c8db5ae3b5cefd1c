from .poses import RegistrationRecall as RegistrationRecall
from .poses import RelativePoseError as RelativePoseError
from .poses import absolute_trajectory_error as absolute_trajectory_error
from .poses import align_rigid as align_rigid
from .poses import point_distance as point_distance
from .poses import registration_recall as registration_recall
from .poses import relative_pose_error as relative_pose_error
from .position_bound import position_bound as position_bound

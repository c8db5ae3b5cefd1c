from .graph import Edges as Edges
from .graph import PoseGraph as PoseGraph
from .graph import label_parts as label_parts
from .optimize import OptimizedPoseGraph as OptimizedPoseGraph
from .optimize import PoseGraphConfig as PoseGraphConfig
from .optimize import optimize_pose_graph as optimize_pose_graph

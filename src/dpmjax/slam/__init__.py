"""SLAM: a stream of scans becomes one map by keyframes, odometry, loop closure and one pose graph (DeepPointMap 4)."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

"""One map of many scans: of a stream of lidar scans (DeepPointMap 4), of a set without order, or of planar scans."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

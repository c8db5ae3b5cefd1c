"""Geometry of points and poses: knows nothing of networks, losses or files."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

"""Scans of planar lidars, depth cameras and 3-D lidars: their records, and the alignment and comparison of two."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

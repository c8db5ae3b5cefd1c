"""Raw 3-D scans: preprocessing to masked clouds, augmentation, surfaces and free space, alignment of surfaces."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

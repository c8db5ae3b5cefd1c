"""DeepPointMap: each 3-D scan to a few hundred descriptors, and descriptor clouds registered against each other."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

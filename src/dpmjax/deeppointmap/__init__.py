"""DeepPointMap: descriptor clouds of scans, their matching and registration, and the training of its networks."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

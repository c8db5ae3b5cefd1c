"""Registration by training: L-Net and M-Net are optimised on one set of scans (DeepMapping, CVPR 2019)."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

"""Depth cameras: sequences of organised depth images, a furnished apartment to simulate them, and readers."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

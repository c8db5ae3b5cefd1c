"""Maps and states of SLAM in files: versioned, checked on load, exact or small."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

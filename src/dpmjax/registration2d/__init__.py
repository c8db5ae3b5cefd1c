"""Classical registration of planar scans: ICP, chains of ICP, loop closure, refinement, global search, and trust."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

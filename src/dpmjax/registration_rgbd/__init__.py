"""Classical registration of depth images: a search of initial poses by projective consistency."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

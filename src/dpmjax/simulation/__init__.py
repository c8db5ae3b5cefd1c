"""Simulated worlds made by seed: 2-D worlds, apartments, buildings, towns. No algorithm imports them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Readers and writers of scans, depth images, poses and floor plans; NumPy only, and no algorithm imports them.

Bad input raises an `InputError` of one line.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

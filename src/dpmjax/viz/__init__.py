"""Pictures: registered scans, the learned map, the course of a fit. NumPy in, `matplotlib` figures and PNG files out.

The pictures need neither a screen nor `pyplot`; matplotlib is imported with the first name that is used.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

"""Pictures: registered scans, the learned map, the course of a fit. NumPy in, `matplotlib` figures and PNG files out.

Nothing here needs a screen or touches `pyplot`; matplotlib itself is imported when the first picture is drawn.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

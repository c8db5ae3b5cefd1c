"""Readers, writers and simulators, on the NumPy side: no algorithm imports them.

`read_sequence` takes whatever 2-D scans there are and `simulate_sequence` makes some; both return a `ScanSequence`.
`open_lidar_sequence` and `simulate_lidar_sequence` do the same in space, and return a `LidarSequence`. Bad input ends
in an `InputError` of one line.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

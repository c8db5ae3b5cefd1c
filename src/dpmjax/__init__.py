"""Lidar scans to one consistent map: DeepMapping and DeepPointMap as pure JAX functions.

Flow of the data, and the package of each step:

1. `io` reads scans from disk, `simulation` makes worlds: NumPy arrays on the host.
2. `scan` makes the record of a planar scan, a depth image or a lidar scan, and aligns and compares two of them.
3. `slam` makes one map of many scans, `pose_graph` solves its graph.
4. `deepmapping` registers a whole set by training two small networks (`nets`) under two losses (`losses`).
5. `deeppointmap` turns each 3-D scan into a few hundred descriptors and registers descriptor clouds.
6. `metrics` compares trajectories with a reference, `viz` draws them.

All packages use `geometry`: poses, alignment, neighbours, sampling, normals, rays. `weights` and `saved_maps` are the
files of models and maps. Public names and packages (`dpmjax.scan`, say) are loaded on first use, so that
`import dpmjax` costs nothing.
"""

import lazy_loader as _lazy

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

from .map_arrays import Precision as Precision
from .map_file import RunState as RunState
from .map_file import load_map as load_map
from .map_file import load_state as load_state
from .map_file import map_bytes as map_bytes
from .map_file import save_map as save_map
from .map_file import save_state as save_state

from .map_arrays import Precision as Precision
from .map_file import load_map as load_map
from .map_file import map_bytes as map_bytes
from .map_file import save_map as save_map
from .run_state import RunState as RunState
from .run_state import load_state as load_state
from .run_state import save_state as save_state

from .descriptors import info_nce as info_nce
from .descriptors import offset_loss as offset_loss
from .mapping import chamfer_distance as chamfer_distance
from .mapping import occupancy_loss as occupancy_loss

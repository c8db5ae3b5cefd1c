from .chamfer import chamfer_distance as chamfer_distance
from .contrastive import info_nce as info_nce
from .occupancy import occupancy_loss as occupancy_loss

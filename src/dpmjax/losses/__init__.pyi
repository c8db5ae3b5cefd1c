from .chamfer import chamfer_distance as chamfer_distance
from .contrastive import info_nce as info_nce
from .occupancy import occupancy_loss as occupancy_loss
from .offset import offset_loss as offset_loss
from .overlap import overlap_loss as overlap_loss

from .decoder import DecoderConfig as DecoderConfig
from .decoder import DescriptorDecoder as DescriptorDecoder
from .occupancy import OccupancyConfig as OccupancyConfig
from .point_encoder import EncoderConfig as EncoderConfig
from .point_encoder import PointEncoder as PointEncoder
from .scalar import Initialization as Initialization
from .scalar import ScalarNet as ScalarNet
from .scalar import ScalarNetConfig as ScalarNetConfig

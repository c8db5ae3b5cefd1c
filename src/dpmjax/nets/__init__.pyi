from .decoder import DecoderConfig as DecoderConfig
from .decoder import DescriptorDecoder as DescriptorDecoder
from .localization import Initialization as Initialization
from .localization import ScalarNet as ScalarNet
from .localization import ScalarNetConfig as ScalarNetConfig
from .occupancy import OccupancyConfig as OccupancyConfig
from .point_encoder import EncoderConfig as EncoderConfig
from .point_encoder import PointEncoder as PointEncoder

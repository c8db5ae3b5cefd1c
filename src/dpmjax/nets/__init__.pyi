from .decoder import DecoderConfig as DecoderConfig
from .decoder import DescriptorDecoder as DescriptorDecoder
from .mapping import OccupancyConfig as OccupancyConfig
from .point_encoder import EncoderConfig as EncoderConfig
from .point_encoder import PointEncoder as PointEncoder

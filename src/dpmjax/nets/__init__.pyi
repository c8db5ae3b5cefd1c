from .decoder import DecoderConfig as DecoderConfig
from .decoder import DescriptorDecoder as DescriptorDecoder
from .point_encoder import EncoderConfig as EncoderConfig
from .point_encoder import PointEncoder as PointEncoder
from .scalar import ScalarNet as ScalarNet
from .scalar import ScalarNetConfig as ScalarNetConfig

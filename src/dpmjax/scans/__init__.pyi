from .augment import AugmentConfig as AugmentConfig
from .augment import BoxConfig as BoxConfig
from .augment import SectorConfig as SectorConfig
from .augment import augment_scan as augment_scan
from .preprocess import PreprocessConfig as PreprocessConfig
from .preprocess import preprocess_scan as preprocess_scan
from .preprocess import preprocess_scan_on_host as preprocess_scan_on_host

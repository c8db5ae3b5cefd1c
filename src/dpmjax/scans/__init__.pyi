from .augment import AugmentConfig as AugmentConfig
from .augment import AugmentedScan as AugmentedScan
from .augment import augment_scan as augment_scan
from .occlusion import BoxConfig as BoxConfig
from .occlusion import SectorConfig as SectorConfig
from .preprocess import PreprocessConfig as PreprocessConfig
from .preprocess import preprocess_scan as preprocess_scan
from .preprocess_host import preprocess_scan_on_host as preprocess_scan_on_host

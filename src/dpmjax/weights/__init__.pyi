from .checkpoint import load_model as load_model
from .checkpoint import read_card as read_card
from .checkpoint import save_model as save_model
from .checkpoint import shipped_models as shipped_models
from .torch_file import read_torch_file as read_torch_file
from .torch_import import import_torch_checkpoint as import_torch_checkpoint

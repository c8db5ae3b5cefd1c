from .model_file import load_model as load_model
from .model_file import read_card as read_card
from .model_file import save_model as save_model
from .model_file import shipped_models as shipped_models

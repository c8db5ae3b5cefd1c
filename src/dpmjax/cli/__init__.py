"""The installed command `dpmjax`: one file for each subcommand, and common options, run folders and exit codes."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

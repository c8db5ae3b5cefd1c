"""The installed command `dpmjax`: one file a subcommand, and what commands share: options, run folders, exit codes."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

"""Runs the code of the quick start with the installed package: python docs/quick_start.py."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).with_name("quickstart.md")

if __name__ == "__main__":
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    exec(compile("\n".join(blocks), PAGE.name, "exec"), {"__name__": "quick start"})

"""Speed, memory and accuracy, measured side by side with peers in one run; compile time apart from run time.

A benchmark is a function `run(quick: bool) -> list[Row]`; `__main__.py` has the list of them.
"""

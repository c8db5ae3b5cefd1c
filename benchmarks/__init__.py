"""Speed, memory and accuracy, measured side by side with peers in one run; compile time apart from run time.

A benchmark is a module of this package with a `NAME` and a function `run(quick: bool) -> list[Row]`.
"""

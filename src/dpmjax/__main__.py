"""`python -m dpmjax` is the command `dpmjax`."""

from dpmjax.cli.program import run

if __name__ == "__main__":
    run()

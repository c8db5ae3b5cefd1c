"""`python -m dpmjax` is the command `dpmjax`."""

from dpmjax.cli.program import main

if __name__ == "__main__":
    raise SystemExit(main())

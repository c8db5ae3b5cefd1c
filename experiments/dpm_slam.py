"""The same as `dpmjax slam`."""

import sys

from dpmjax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["slam", *sys.argv[1:]]))

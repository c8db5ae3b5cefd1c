"""The same as `dpmjax map2d`."""

import sys

from dpmjax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["map2d", *sys.argv[1:]]))

"""The same as `dpmjax map2d`."""

import sys

from dpmjax.cli import end_process, main

if __name__ == "__main__":
    end_process(main(["map2d", *sys.argv[1:]]))

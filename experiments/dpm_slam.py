"""The same as `dpmjax slam`."""

import sys

from dpmjax.cli import end_process, main

if __name__ == "__main__":
    end_process(main(["slam", *sys.argv[1:]]))

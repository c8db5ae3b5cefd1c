"""The same as `dpmjax train`."""

import sys

from dpmjax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["train", *sys.argv[1:]]))

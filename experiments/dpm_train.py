"""The same as `dpmjax train`."""

import sys

from dpmjax.cli import end_process, main

if __name__ == "__main__":
    end_process(main(["train", *sys.argv[1:]]))

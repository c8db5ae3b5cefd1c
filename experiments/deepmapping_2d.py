"""The same as `dpmjax map2d`."""

from dpmjax.cli.map2d import run

if __name__ == "__main__":
    raise SystemExit(run())

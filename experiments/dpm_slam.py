"""The same as `dpmjax slam`."""

from dpmjax.cli.slam import run

if __name__ == "__main__":
    raise SystemExit(run())

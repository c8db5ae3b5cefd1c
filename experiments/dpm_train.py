"""The same as `dpmjax train`."""

from dpmjax.cli.train import run

if __name__ == "__main__":
    raise SystemExit(run())

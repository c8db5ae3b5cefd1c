"""A package of an extra that is missing or broken is named in one line, and nothing is begun without it."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dpmjax.cli import program, slam
from dpmjax.cli.info import EXTRAS, require_importable, why_not_importable
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_OK, run_command
from experiments import deepmapping_rgbd, deepmapping_suite, toy_1d

LIBUSB = "libusb-1.0.so.0: cannot open shared object file"
PACKAGES = [name for names in EXTRAS.values() for name in names]
FAILURES = {
    "a missing library": f"raise OSError({LIBUSB!r})",
    "a missing symbol": f"raise ImportError({LIBUSB!r})",
    "another version of NumPy": f"raise ValueError({LIBUSB!r})",
    "an error of many lines": f"raise RuntimeError({LIBUSB!r} + chr(10) + 'more')",
}


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of fake packages, found before those that are installed."""
    folder = tmp_path / "packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    for name in (*PACKAGES, "broken"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield folder
    for name in (*PACKAGES, "broken"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("failure", FAILURES)
def test_the_error_of_a_broken_package_is_one_line(packages: Path, failure: str) -> None:
    (packages / "broken.py").write_text(FAILURES[failure])
    reason = why_not_importable("broken")
    assert reason == f"broken is installed, but its import fails: {LIBUSB}"
    with pytest.raises(ValueError, match="^--methods x: broken is installed"):
        require_importable("broken", "--methods x")


def test_a_missing_package_is_named_with_its_extra(packages: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert why_not_importable("open3d") == "open3d is not installed (pip install 'dpmjax[baselines]')"
    (packages / "kiss_slam").mkdir()
    (packages / "kiss_slam" / "slam.py").write_text("import open3d")
    (packages / "kiss_slam" / "__init__.py").touch()
    # The one that is missing is named, not the one that needs it.
    assert why_not_importable("kiss_slam.slam") == "open3d is not installed (pip install 'dpmjax[baselines]')"
    assert why_not_importable("no_such_package") == "no_such_package is not installed (pip install 'no_such_package')"
    (packages / "broken.py").write_text("import warnings; warnings.warn('old', DeprecationWarning)")
    assert why_not_importable("broken") is None


def test_info_names_what_is_broken_and_what_is_missing(packages: Path, monkeypatch, capsys) -> None:
    for name in PACKAGES:
        (packages / f"{name}.py").touch()
    (packages / "open3d.py").write_text(FAILURES["a missing library"])
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert program.main(["info"]) == EXIT_OK
    lines = [line.removeprefix("extra").strip() for line in capsys.readouterr().out.splitlines()]
    assert f"baselines: open3d is installed, but its import fails: {LIBUSB}" in lines
    assert "gtsam: gtsam is not installed (pip install 'dpmjax[gtsam]')" in lines
    assert "peers: installed" in lines


@pytest.mark.parametrize(
    ("module", "arguments", "package", "named"),
    [
        (deepmapping_rgbd, ["--methods", "multiway"], "open3d", "--methods multiway"),
        (deepmapping_suite, ["--methods", "icp-plane", "multiway"], "open3d", "--methods multiway"),
        (deepmapping_suite, ["--methods", "swarm-poses"], "evosax", "--methods swarm-poses"),
        (slam, ["-v"], "rerun", "-v"),
        (toy_1d, [], "jaxopt", "the solvers of the direct form"),
    ],
)
def test_a_command_names_a_broken_package_before_any_work(
    packages: Path, tmp_path, capsys, module, arguments, package, named
) -> None:
    (packages / f"{package}.py").write_text(FAILURES["a missing library"])
    options = [*arguments, "-o", str(tmp_path / "out")]
    code = run_command(module.main, name="command", description=None, args=options)
    assert code == EXIT_BAD_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines == [f"dpmjax: error: {named}: {package} is installed, but its import fails: {LIBUSB}"]
    assert not (tmp_path / "out").exists()

"""Examples run, and the pages show their code: README and quick start as printed, guides as quoted and as a whole."""

import re
import runpy
from pathlib import Path

import pytest

from tests.optional import import_or_skip
from tests.processes import REPOSITORY as ROOT
from tests.processes import run_python

EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
GUIDES = sorted((ROOT / "docs" / "guides").glob("*.md"))
QUICK = ("06", "10")
"""Examples of seconds; the others train, or map a drive."""
LONG = (pytest.mark.slow, pytest.mark.timeout(900))


def _blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def _marked(path: Path):
    return pytest.param(path, id=path.stem, marks=() if path.name.startswith(QUICK) else LONG)


@pytest.mark.parametrize("path", [_marked(path) for path in EXAMPLES])
def test_example_runs(path, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["README.md", "docs/quickstart.md", *(f"docs/guides/{each.name}" for each in GUIDES)])
def test_code_of_a_page_runs_as_printed(name, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    code = "\n".join(_blocks(ROOT / name))
    exec(compile(code, name, "exec"), {})
    assert ("print(" in code) == bool(capsys.readouterr().out)


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_code_of_a_guide_is_that_of_an_example_that_it_names(guide) -> None:
    named = re.findall(r"\]\(../../examples/([\w.]+)\)", guide.read_text(encoding="utf-8"))
    sources = [(ROOT / "examples" / name).read_text(encoding="utf-8") for name in named]
    blocks = _blocks(guide)
    assert blocks
    for block in blocks:
        assert any(block in source for source in sources), block


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_code_of_a_guide_defines_all_its_names(guide, tmp_path) -> None:
    """The blocks of a guide run in order, so no name may come from the example alone."""
    code = tmp_path / "guide.py"
    code.write_text("\n".join(_blocks(guide)))
    done = run_python("-m", "ruff", "check", "--isolated", "--select", "F821", "--output-format", "concise", code)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_code_of_pages_and_examples_has_no_type_error_by_the_library(tmp_path) -> None:
    pages = [ROOT / "README.md", ROOT / "docs" / "quickstart.md", *GUIDES]
    for path in (*pages, *EXAMPLES):
        code = path.read_text(encoding="utf-8") if path.suffix == ".py" else "\n".join(_blocks(path))
        (tmp_path / f"{path.suffix[1:]}_{path.stem.lower()}.py").write_text(code)
    # The functions of the pages are short and have no annotations, and optax ships none.
    own = ["no-untyped-def", "no-untyped-call", "import-untyped", "no-redef", "untyped-decorator"]
    options = ["--strict", "--follow-imports=silent", *(f"--disable-error-code={code}" for code in own)]
    options += ["--cache-dir", ROOT / ".mypy_cache" / "pages", *sorted(tmp_path.iterdir())]
    done = run_python("-m", "mypy", *options, variables={"MYPYPATH": str(ROOT / "src")})
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_notebook_runs(tmp_path) -> None:
    nbformat, nbclient = (import_or_skip(name) for name in ("nbformat", "nbclient"))
    notebook = nbformat.read(ROOT / "docs" / "notebooks" / "tour.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)  # outputs are of another day
    nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": tmp_path}}).execute()
    kinds = [set(output.get("data", {})) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert sum("image/png" in kind for kind in kinds) == 3


def test_examples_are_numbered_and_short() -> None:
    assert [path.name[:3] for path in EXAMPLES] == [f"{number:02}_" for number in range(1, len(EXAMPLES) + 1)]
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 40, path.name

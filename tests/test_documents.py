"""The pages agree with the tree: the plan of the rooms, files, links, settings, dependencies, lengths."""

import re
import runpy
import tomllib
from pathlib import Path

import pytest

from tests.test_import_rules import ALLOWED, EVERYBODY_MAY

ROOT = Path(__file__).parents[1]
FILES = {path.relative_to(ROOT).as_posix() for top in ("src", "experiments") for path in (ROOT / top).rglob("*")}


def test_contributing_tells_who_may_import_whom() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|[^|]*\|([^|]*)\|$", text, re.MULTILINE)
    assert {room: set(re.findall(r"`(\w+)`", may)) for room, may in rows} == {
        room: may for room, may in ALLOWED.items() if room not in EVERYBODY_MAY
    }
    assert all(f"`{room}`" in text for room in EVERYBODY_MAY)


GUIDES = [f"docs/guides/{path.name}" for path in sorted((ROOT / "docs" / "guides").glob("*.md"))]
READERS = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))), *GUIDES]
NOTEBOOKS = [f"docs/notebook/{path.name}" for path in sorted((ROOT / "docs" / "notebook").glob("*.md"))]


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *READERS])
def test_files_that_a_page_names_exist(page) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/*]+(?:\.py|/))`", text))
    assert named or page != "CONTRIBUTING.md"
    for name in named - {"slam/", "checkpoints/", "rows/"}:
        pattern = re.compile(f"(.*/)?{re.escape(name.rstrip('/')).replace(re.escape('*'), '[^/]*')}")
        assert any(map(pattern.fullmatch, FILES)) or (ROOT / name).exists(), f"{page} names {name}"


def _anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", *READERS, *NOTEBOOKS])
def test_links_of_a_page_lead_somewhere(name) -> None:
    page = ROOT / name
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#?([^)]*)\)", page.read_text(encoding="utf-8")):
        linked = page.parent / target if target else page
        assert linked.exists(), f"{name} links to {target}"
        assert not anchor or anchor in _anchors(linked), f"{name} links to {target}#{anchor}"


MAX_WORDS = {"README.md": 700, "docs/results.md": 1500, **dict.fromkeys(GUIDES, 800)}


@pytest.mark.parametrize("name", MAX_WORDS)
def test_a_page_is_short(name) -> None:
    assert len((ROOT / name).read_text(encoding="utf-8").split()) <= MAX_WORDS[name]


def test_settings_page_is_that_of_the_code() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "make_settings.py"))
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == made["page"](), "run: python docs/make_settings.py"


def test_printed_outputs_are_those_of_the_examples() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "run_examples.py"))
    codes = {path.name: made["fingerprint"](path) for path in made["EXAMPLES"]}
    kept = {name: found["code"] for name, found in made["outputs"]().items()}
    assert kept
    assert kept.items() <= codes.items(), "run: python docs/run_examples.py"


def test_dependencies_page_has_a_line_for_each_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    tables = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8").partition("## Extras")
    needed = {re.match(r"[\w.-]+", line).group() for line in project["dependencies"]}
    assert needed == set(re.findall(r"^\| ([\w.-]+) \|", tables[0], re.MULTILINE)) - {"package"}
    extras = {
        name: {re.match(r"[\w.-]+", line).group() for line in lines}
        for name, lines in project["optional-dependencies"].items()
    }
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", tables[2], re.MULTILINE)
    assert extras == {name: set(packages.strip().split(", ")) for name, packages in rows}


def test_result_files_name_no_path_of_a_machine() -> None:
    files = sorted((ROOT / "docs" / "results").glob("*.json"))
    assert files
    for path in files:
        found = re.search(r'"(?:/[\w.-]+){2,}|"[A-Z]:\\', path.read_text(encoding="utf-8"))
        assert found is None, f"{path.name}: {found}"
